"""The control process: runs the 50 Hz loop on the robot and outlives the planner.

It owns the connection to the robot. If the planner's process ends or hangs, the robot is held.
On a normal exit, an exception or a signal that can be handled its last commands damp the motors. If
it is killed, the watchdog of the planner's process does; if both are gone, the motors keep the last
command. A robot that it does not command is not damped: another program may balance it.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Sequence
from contextlib import closing, suppress
from ctypes import c_bool
from typing import Final

from egovcp.errors import EgovcpError
from egovcp.rate import FixedRate, MonotonicClock
from egovcp.robot.controllers import make_controller
from egovcp.spec import CONTROLLER_HZ
from egovcp.terminal import echo, one_line
from egovcp.workers import stop_on_signal
from egovcp_deploy.live.control import ControlLoop, damping_command
from egovcp_deploy.live.hardware import Hardware, RobotOptions, open_hardware
from egovcp_deploy.live.link import Link, RemotePlanner
from egovcp_deploy.live.operators import RemoteControlInput
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.bridge import BridgeRobot

#: Real-time priorities of threads that receive, and of the loop. The kernel's own threads have 50.
RECEIVER_PRIORITY: Final = 10
CONTROL_PRIORITY: Final = 20
NO_PRIORITY: Final = (
    "no real-time priority: other programs may delay the balance; add the line "
    f"'USER - rtprio {CONTROL_PRIORITY}' to /etc/security/limits.conf, and log in again"
)
_STOP_SIGNALS: Final = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_NICE: Final = -10
_ORPHAN_TICKS: Final = 100  # the process of a damped robot without a planner ends after 2 s
_DAMPING_COMMANDS: Final = 10  # at the end of the process
_DAMPING_PERIOD_NS: Final = 5_000_000
_SWITCH_S: Final = 0.001  # longest wait of the loop for a receiving thread


def control_process(options: RobotOptions, address: str, parent: int, commanded: c_bool) -> None:
    """Main function of the process; returns on a quit command, on SIGTERM, SIGHUP or SIGQUIT, or
    2 s after the planner's process ``parent`` has ended, once the motors are damped. ``address`` is
    that of the link between them; ``commanded``, in shared memory, tells whether motor commands are
    sent (see `ControlLoop.tick`)."""
    os.setsid()  # no SIGHUP, SIGTSTP or SIGQUIT from the terminal to the process that balances
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the planner's process
    with stop_on_signal(signals=_STOP_SIGNALS, interrupt=False) as stopping:
        sys.setswitchinterval(_SWITCH_S)
        # Before there are threads: one that holds the interpreter's lock must not be preempted.
        raise_priority(RECEIVER_PRIORITY)
        try:
            hardware = open_hardware(options.bridge, options.camera)
        except EgovcpError as error:
            # The line above may be an unfinished progress bar.
            echo("\n" + one_line(f"egovcp-deploy: error: {error}"), error=True)
            sys.exit(error.exit_code)
        with closing(hardware), closing(Link(address, serve=False)) as link:
            try:
                control = ControlProcess(options, parent, hardware, link, commanded)
                if not raise_priority(CONTROL_PRIORITY):
                    control.add_event(f"warning: {NO_PRIORITY}")
                gc.freeze()  # imported objects are not searched for garbage again
                control.run(stopping)
            finally:
                if commanded.value:
                    damp_motors(hardware.body)


class ControlProcess:
    """The control loop with its inputs: operator commands, remote control, parent process;
    ``commanded`` as in `control_process`."""

    def __init__(
        self,
        options: RobotOptions,
        parent: int,
        hardware: Hardware,
        link: Link,
        commanded: c_bool,
    ) -> None:
        self._parent, self._commanded = parent, commanded
        self._body = hardware.body
        self._planner = RemotePlanner(link)
        self._loop = ControlLoop(
            hardware.body,
            hardware.camera,
            make_controller(options.controller),
            Pilot(self._planner, options.limits),
            hardware.link,
        )
        self._remote = RemoteControlInput()
        self._orphaned = 0

    def add_event(self, event: str) -> None:
        """Report ``event`` to the planner's process, which prints and logs it."""
        self._loop.pilot.add_events([event])

    def run(self, stopping: Sequence[int]) -> None:
        """Run until a quit command, until ``stopping`` is not empty, or until the robot is damped
        and the planner's process has been gone for 2 s."""
        rate = FixedRate(CONTROLLER_HZ, MonotonicClock())
        rate.start()
        while not stopping and self._orphaned < _ORPHAN_TICKS:
            now = rate.clock.now_ns()
            commands = self._planner.take_commands()
            if any(command.quit for command in commands):
                return
            if (reading := self._body.read()) is not None:
                commands += self._remote.commands(reading.remote)
            self._loop.tick(now, merged(commands))
            self._commanded.value = self._loop.commanding
            self._check_parent()
            rate.wait()

    def _check_parent(self) -> None:
        if os.getppid() == self._parent:
            return
        idle = self._loop.state in (State.INIT, State.DAMP)
        if self._planner.alive and not idle:
            print_without_blocking(
                "egovcp-deploy: the planner's process has ended; the robot is held until it is "
                f"damped: by kill {os.getpid()}, or by L1 + B on its remote control"
            )
        self._planner.alive = False
        self._orphaned += idle


def merged(commands: Sequence[OperatorCommand]) -> OperatorCommand:
    """The commands of one tick as one, with the last velocity. The request is an emergency stop if
    there is one, else a hold if there is one, else the last."""
    requests = [command.request for command in commands if command.request]
    velocities = [command.velocity for command in commands if command.velocity]
    urgent = [r for r in (OperatorRequest.ESTOP, OperatorRequest.HOLD) if r in requests]
    request = next(iter([*urgent, *reversed(requests)]), None)
    return OperatorCommand(request, velocities[-1] if velocities else None)


def print_without_blocking(line: str) -> None:
    """Print on stderr in a daemon thread: a stopped terminal or a full pipe blocks the writer."""

    def write() -> None:
        with suppress(OSError):  # the terminal may be closed
            # Not `echo`, which would hold the lock of sys.stderr; the exit of the process needs it.
            os.write(sys.stderr.fileno(), f"{one_line(line)}\n".encode())

    threading.Thread(target=write, daemon=True).start()


def damp_motors(body: BridgeRobot) -> None:
    """Send several damping commands, 5 ms apart."""
    clock = MonotonicClock()
    for _ in range(_DAMPING_COMMANDS):
        reading = body.read()
        position, mode = (None, 0) if reading is None else (reading.joint_position, reading.mode)
        body.write(damping_command(position, mode))
        clock.sleep_until(clock.now_ns() + _DAMPING_PERIOD_NS)


def raise_priority(level: int) -> bool:
    """Give real-time priority ``level`` (1 to 99) to the calling thread and the threads that it
    starts from now on; returns whether it was granted. SCHED_FIFO needs root, CAP_SYS_NICE, or an
    ``rtprio`` limit in /etc/security/limits.conf. Where it is refused, the nice value is lowered.
    """
    thread = threading.get_native_id()
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(level))
    except (AttributeError, OSError):  # the former: not Linux
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, _NICE)
        return False
    return True
