"""Milliseconds of a planner tick beside the planning, per part.

    control   the 50 Hz control tick of a simulated robot on the wire, with the checks of readings
              and without: from when a tick is due until its command is sent, and between ticks
    filter    the recurrence takes the observation in, the state machine and the safety filter run;
              default model size, one robot, one thread
    logging   what the sinks add to the loop (`tick_logging.py`)

Targets, not enforced: filter, safety and the hand-off to the logs take less than 3 ms together at
the 99th percentile, of which logging adds less than 1 ms, also with a stalled disk or a dead
viewer; the checks make a control tick at most 5 % longer. Each part runs in its own process. The
cases of control and of logging take turns of a second.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import torch
from report import parser, publish

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for tests.support

from tick_logging import logging_metrics, percentiles

from egovcp.model import WorldModel, WorldModelConfig
from egovcp.plan import PlannerConfig, Policy, PolicyStep
from egovcp.rate import FixedRate, MonotonicClock
from egovcp.robot.controllers import make_controller
from egovcp.spec import ACTION_DIM, CONTROLLER_HZ, PLANNER_HZ, STATE_DIM, STATE_SLICES
from egovcp_deploy.live.control import ControlLoop
from egovcp_deploy.live.control_process import CONTROL_PRIORITY, RECEIVER_PRIORITY, raise_priority
from egovcp_deploy.live.hardware import CameraOptions, Hardware, open_hardware
from egovcp_deploy.pilot.motor_watch import MotorVerdict, MotorWatch
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.planner import InlinePlanner, PlannerRunner
from egovcp_deploy.pilot.states import Facts, OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.base import LowState, MotorCommand
from egovcp_deploy.robots.plausibility import PlausibilityFilter
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig
from tests.support.lockstep import LockstepClock
from tests.support.robots.fake_g1 import bridge_config, fake_g1_process, raised_priority

_CONTROLLER = "stance"
_SETTLE_TICKS = 10  # after a switch between the two cases
_TICK_NS = 1_000_000_000 // PLANNER_HZ


class Unplanned:
    """A policy that takes no time."""

    def reset(self) -> None: ...

    def observe(self, depth: np.ndarray, state: np.ndarray) -> None: ...

    def advance(self, sent: np.ndarray) -> None: ...

    def act(
        self,
        depth: np.ndarray,
        state: np.ndarray,
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        action = np.zeros((1, ACTION_DIM), np.float32)
        return PolicyStep(action)


class _Unchecked(PlausibilityFilter):
    """Accepts all readings."""

    def check(self, state: LowState) -> str:
        return ""


class _Unwatched(MotorWatch):
    """Reports no fault."""

    def update(
        self, reading: LowState, command: MotorCommand | None, standing: bool = True
    ) -> MotorVerdict:
        return MotorVerdict()


def _loop(hardware: Hardware, checked: bool) -> ControlLoop:
    pilot = Pilot(InlinePlanner(PlannerRunner(Unplanned())), state=State.ARMED)
    controller = make_controller(_CONTROLLER)
    loop = ControlLoop(hardware.body, hardware.camera, controller, pilot, hardware.link)
    if not checked:
        loop._motor_watch = _Unwatched()
    return loop


def control_metrics(rounds: int) -> dict[str, object]:
    """Percentiles of ``rounds`` seconds of each case, which take turns of a second. Changes the
    priority and the switch interval of the process."""
    late: dict[str, list[float]] = {"checked": [], "unchecked": []}
    interval: dict[str, list[float]] = {"checked": [], "unchecked": []}
    sys.setswitchinterval(0.001)  # as the control process does
    with ExitStack() as stack:
        with raised_priority(RECEIVER_PRIORITY):  # for the simulated robot, too
            fake = stack.enter_context(fake_g1_process("--task=ball", "--pause=1e9"))
            camera = CameraOptions(server=ZmqCameraConfig(port=fake.ports.camera_port))
            hardware = stack.enter_context(closing(open_hardware(bridge_config(fake), camera)))
        granted = raise_priority(CONTROL_PRIORITY)
        for turn in range(2 * rounds):
            checked = turn % 2 == 0
            name = "checked" if checked else "unchecked"
            hardware.body._filter = PlausibilityFilter() if checked else _Unchecked()
            _measure(_loop(hardware, checked), late[name], interval[name])
    metrics: dict[str, object] = {"control_real_time_priority": granted}
    for what, values in (("control_tick", late), ("control_interval", interval)):
        for name, times in values.items():
            metrics |= percentiles(f"{what}_{name}", times)
        ratio = np.percentile(values["checked"], 99) / np.percentile(values["unchecked"], 99)
        metrics[f"{what}_p99_ratio"] = float(ratio)
    return metrics


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


def filter_metrics(rounds: int) -> dict[str, object]:
    """Percentiles over ``rounds`` seconds of ticks without pauses."""
    torch.set_num_threads(1)
    policy = Policy(WorldModel(WorldModelConfig()), PlannerConfig(), 1)
    clock = LockstepClock()
    pilot = Pilot(InlinePlanner(PlannerRunner(Unplanned())), state=State.ARMED)
    rng = np.random.default_rng(0)
    observe, judge = list[float](), list[float]()
    for _ in range(rounds * PLANNER_HZ):
        depth, state = _observation(rng)
        begin = time.perf_counter()
        policy.observe(depth[None], state[None])
        policy.advance(np.zeros((1, ACTION_DIM)))
        filtered = time.perf_counter()
        pilot.sense(clock.now_ns(), state, depth)
        pilot.update_state(Facts(clock.now_ns()))
        pilot.send_observation(clock.now_ns(), depth, state)
        pilot.receive_plans(clock.now_ns())
        pilot.next_action()
        judge.append(time.perf_counter() - filtered)
        observe.append(filtered - begin)
        clock.advance(_TICK_NS)
    both = [a + b for a, b in zip(observe, judge, strict=True)]
    return {
        **percentiles("filter_observe", observe),
        **percentiles("filter_pilot", judge),
        **percentiles("filter", both),
    }


def _observation(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    depth = rng.integers(280, 5000, (48, 64)).astype(np.uint16)
    state = rng.normal(0, 0.01, STATE_DIM).astype(np.float32)
    state[STATE_SLICES["projected_gravity"].stop - 1] = -1.0
    return depth, state


#: Part of a tick -> its metrics, from the number of seconds to measure each case for.
PARTS: Mapping[str, Callable[[int], dict[str, object]]] = {
    "control": control_metrics,
    "filter": filter_metrics,
    "logging": logging_metrics,
}


def main() -> None:
    p = parser(__doc__, rounds_help="seconds of each case")
    p.add_argument("--parts", nargs="*", choices=sorted(PARTS), default=sorted(PARTS))
    args = p.parse_args()
    metrics: dict[str, object] = {}
    for part in args.parts:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            metrics |= process.submit(PARTS[part], args.rounds).result()
    publish(metrics, args.json)


if __name__ == "__main__":
    main()
