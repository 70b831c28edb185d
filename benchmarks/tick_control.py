"""The 50 Hz control tick against the simulated robot on the wire, with the checks of readings and
without: milliseconds from when a tick is due until its command is sent, and from one to the next.
"""

from __future__ import annotations

import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from tick_filter import Unplanned
from tick_logging import percentiles

from egovcp.rate import FixedRate, MonotonicClock
from egovcp.robot.controllers import make_controller
from egovcp.spec import CONTROLLER_HZ
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.live.control import ControlLoop
from egovcp_deploy.live.control_process import CONTROL, RECEIVING, raise_priority, raised_priority
from egovcp_deploy.live.hardware import Hardware, open_hardware
from egovcp_deploy.live.processes import simulated_robot
from egovcp_deploy.pilot.motor_watch import MotorVerdict, MotorWatch
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.planner import InlinePlanner, PlannerRunner
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.base import LowState, MotorCommand
from egovcp_deploy.robots.plausibility import PlausibilityFilter

_CONTROLLER = "stance"
_SETTLE_TICKS = 10  # after a switch between the two cases


class _Unchecked(PlausibilityFilter):
    """Accepts every reading."""

    def check(self, state: LowState) -> str:
        """Find nothing."""
        return ""


class _Unwatched(MotorWatch):
    """Finds nothing."""

    def update(
        self, reading: LowState, command: MotorCommand | None, standing: bool = True
    ) -> MotorVerdict:
        """Nothing is wrong."""
        return MotorVerdict()


def _loop(hardware: Hardware, clock: MonotonicClock, checked: bool) -> ControlLoop:
    body = hardware.body
    pilot = Pilot(InlinePlanner(PlannerRunner(Unplanned()), clock), state=State.ARMED)
    controller = make_controller(_CONTROLLER)
    if not checked:
        loop = ControlLoop(body, hardware.eye, controller, pilot)
        loop._motor_watch = _Unwatched()
        return loop
    return ControlLoop(
        body,
        hardware.eye,
        controller,
        pilot,
        refusal=lambda: body.trouble,
        fault=lambda: body.fault,
        skipped=lambda: body.skipped,
        link=hardware.link,
    )


def control_figures(rounds: int) -> dict[str, object]:
    """Percentiles of ``rounds`` seconds of each case, which take turns of a second."""
    config = DeployConfig(task="ball")
    late: dict[str, list[float]] = {"checked": [], "unchecked": []}
    interval: dict[str, list[float]] = {"checked": [], "unchecked": []}
    sys.setswitchinterval(0.001)  # as the control process does
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        with raised_priority(RECEIVING):  # for the robot too, which has computers of its own
            options = stack.enter_context(simulated_robot(config, folder / "outcomes.json"))
            hardware = open_hardware(options)
        granted = raise_priority(CONTROL)
        try:
            clock = MonotonicClock()
            for turn in range(2 * rounds):
                checked = turn % 2 == 0
                name = "checked" if checked else "unchecked"
                hardware.body._filter = PlausibilityFilter() if checked else _Unchecked()
                _measure(_loop(hardware, clock, checked), late[name], interval[name])
        finally:
            hardware.close()
    figures: dict[str, object] = {"control_real_time_priority": granted}
    for what, values in (("control_tick", late), ("control_interval", interval)):
        for name, times in values.items():
            figures |= percentiles(f"{what}_{name}", times)
        ratio = np.percentile(values["checked"], 99) / np.percentile(values["unchecked"], 99)
        figures[f"{what}_p99_ratio"] = float(ratio)
    return figures


def _measure(loop: ControlLoop, late: list[float], interval: list[float]) -> None:
    """A second of ticks."""
    rate = FixedRate(CONTROLLER_HZ, MonotonicClock())
    rate.start()
    begin, previous = time.monotonic(), 0.0
    for k in range(CONTROLLER_HZ + _SETTLE_TICKS):
        loop.tick(rate.clock.now_ns(), OperatorCommand(OperatorRequest.RUN if k == 0 else None))
        done = time.monotonic()
        if k >= _SETTLE_TICKS:
            late.append(done - begin - k / CONTROLLER_HZ)
            interval.append(done - previous)
        previous = done
        rate.wait()
