"""The control process: the 50 Hz loop on the robot, which outlives the planner.

It owns the wire to the robot. If the planner's process dies or stops, it holds the robot; if it
ends itself, in whatever way, the last thing it tells the motors is to damp.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from egovcp.errors import EgovcpError
from egovcp.rate import FixedRate, MonotonicClock
from egovcp.robot.controllers import make_controller
from egovcp.spec import CONTROLLER_HZ
from egovcp.terminal import echo, one_line
from egovcp_deploy.live import motors
from egovcp_deploy.live.buttons import Buttons
from egovcp_deploy.live.control import NOTHING, ControlLoop, Wishes
from egovcp_deploy.live.hardware import Hardware, HardwareOptions, open_hardware
from egovcp_deploy.live.link import Link, Order, RemoteDesk
from egovcp_deploy.live.priority import CONTROL, RECEIVING, raise_priority
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.states import Limits, Request, State
from egovcp_deploy.robots.base import LowLevelRobot
from egovcp_deploy.robots.remote_control import RemoteControl

_ORPHAN_TICKS: Final = 100  # a damped robot without a planner is left after 2 s
_LAST_WORDS: Final = 10  # how often the motors are told to damp at the end
_SWITCH_S: Final = 0.001  # longest wait of the loop for a thread that receives


@dataclass(frozen=True)
class ControlSetup:
    """All that the control process needs; plain data."""

    address: str
    """Of the link to the planner's process."""
    hardware: HardwareOptions
    """Where the robot is."""
    controller: str
    """Low-level controller, see `make_controller`."""
    limits: Limits
    parent: int
    """Process id of the planner."""


def control_process(setup: ControlSetup) -> None:
    """LowLevelRobot of the process; returns when it is told to quit, or is no longer needed."""
    os.setsid()  # a terminal that is closed, Ctrl-Z and Ctrl-\ are not for who balances a robot
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the planner's process to judge
    quitting = Flag()
    signal.signal(signal.SIGTERM, lambda number, frame: quitting.set())
    sys.setswitchinterval(_SWITCH_S)
    # before there are threads: one that holds the interpreter's lock must not be put aside either
    raise_priority(RECEIVING)
    try:
        hardware = open_hardware(setup.hardware)
    except EgovcpError as error:
        # a progress bar is above
        echo("\n" + one_line(f"egovcp-deploy: error: {error}"), error=True)
        sys.exit(error.exit_code)
    link = Link(setup.address, serve=False)
    try:
        control = ControlProcess(setup, hardware, link)
        raise_priority(CONTROL)
        gc.freeze()  # what the imports brought is not searched for garbage again
        control.run(quitting)
    finally:
        last_words(hardware.body)
        hardware.close()
        link.close()


class Flag:
    """Set once, from a signal handler."""

    def __init__(self) -> None:
        self.is_set = False

    def set(self) -> None:
        """Set it."""
        self.is_set = True


class ControlProcess:
    """The loop with all that surrounds it: orders, the remote control, the end."""

    def __init__(self, setup: ControlSetup, hardware: Hardware, link: Link) -> None:
        self._parent = setup.parent
        self._hardware = hardware
        self._desk = RemoteDesk(link)
        self._loop = ControlLoop(
            hardware.body,
            hardware.eye,
            make_controller(setup.controller),
            Pilot(self._desk, setup.limits),
            refusal=lambda: hardware.body.refusal,
            fault=lambda: hardware.body.fault,
            skipped=lambda: hardware.body.rejected,
            link=hardware.link,
        )
        self._remote = RemoteKeys()
        self._orphaned = 0

    def run(self, quitting: Flag) -> None:
        """Until told to quit."""
        rate = FixedRate(CONTROLLER_HZ, MonotonicClock())
        rate.start()
        while not quitting.is_set and self._orphaned < _ORPHAN_TICKS:
            now = rate.clock.now_ns()
            orders, self._desk.orders = self._desk.orders, []
            if any(order.quit for order in orders):
                return
            self._loop.tick(now, self._wishes(orders))
            self._look_for_parent()
            rate.wait()

    def _wishes(self, orders: list[Order]) -> Wishes:
        """Of all that came since the last tick: an emergency stop first, else the last."""
        wishes = NOTHING
        for order in [*orders, *self._remote.orders(self._hardware.body)]:
            if wishes.request is Request.ESTOP:
                break
            wishes = Wishes(order.request or wishes.request, order.velocity or wishes.velocity)
        return wishes

    def _look_for_parent(self) -> None:
        if os.getppid() != self._parent:
            if self._desk.alive and self._loop.state not in (State.INIT, State.DAMP):
                _say_who_is_left()
            self._desk.alive = False
            self._orphaned += self._loop.state in (State.INIT, State.DAMP)


def _say_who_is_left() -> None:
    with suppress(OSError):  # the terminal may be gone as well
        echo(
            "egovcp-deploy: the planner's process is gone; the robot is held, and stands until it "
            f"is ended: kill {os.getpid()} damps it, as does L1 + B on its remote control",
            error=True,
        )


class RemoteKeys:
    """The robot's own remote control: its buttons (`Buttons`), and its sticks when they move."""

    def __init__(self) -> None:
        self._buttons = Buttons()

    def orders(self, body: LowLevelRobot) -> list[Order]:
        """What was pressed since the last call, and where the sticks point."""
        reading = body.read()
        remote = None if reading is None else RemoteControl.parse(reading.remote)
        if remote is None:
            return []
        vx, vy, turn = remote.velocity.tolist()
        orders = [Order(velocity=(vx, vy, turn))] if any((vx, vy, turn)) else []
        return orders + self._buttons.orders(remote.pressed)


def last_words(body: LowLevelRobot) -> None:
    """Tell the motors to damp, a few times over."""
    clock = MonotonicClock()
    for _ in range(_LAST_WORDS):
        reading = body.read()
        position, mode = (None, 0) if reading is None else (reading.joint_position, reading.mode)
        body.write(motors.damped(position, mode))
        clock.sleep_until(clock.now_ns() + 5_000_000)
