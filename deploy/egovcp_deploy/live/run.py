"""A run on the wall clock: start the control process, plan and log beside it, end in good order."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.process import BaseProcess

from egovcp.errors import EnvironmentFailure
from egovcp.log.sink import Sink
from egovcp.log.tick import Tick
from egovcp.rate import MonotonicClock
from egovcp.workers import inherited_by_workers
from egovcp_deploy.live.ending import END_S, end
from egovcp_deploy.live.guard import Guard, spare_body
from egovcp_deploy.live.hardware import HardwareOptions
from egovcp_deploy.live.link import Link
from egovcp_deploy.live.operators import Operator
from egovcp_deploy.live.planner import LiveSummary, PlannerLoop
from egovcp_deploy.live.process import ControlSetup, control_process
from egovcp_deploy.live.run_folder import run_folder
from egovcp_deploy.pilot.desk import Thinker
from egovcp_deploy.pilot.states import Limits


@dataclass(frozen=True)
class LiveSetup:
    """What is driven, and how carefully."""

    hardware: HardwareOptions
    controller: str
    limits: Limits
    stays: bool
    """Whether the robot stands until a second Ctrl-C."""
    simulated: bool = False
    """Whether the robot ends with the run, so that nothing is gained by letting it stand."""


def run_live(
    setup: LiveSetup,
    thinker: Thinker,
    operator: Operator,
    sink: Sink,
    on_tick: Callable[[Tick], None] = lambda tick: None,
) -> LiveSummary:
    """Drive the robot until the operator ends it or its motors are damped.

    An exception in the planning leaves the robot standing until then: `LiveSummary.failure`.

    Raises:
        EnvironmentFailure: the robot does not answer, or the control process died.
    """
    with ExitStack() as stack:
        folder = stack.enter_context(run_folder())
        address = f"ipc://{folder}/link"
        link = Link(address, serve=True)
        stack.callback(link.close)
        spare = stack.enter_context(spare_body(setup.hardware.bridge))
        process = stack.enter_context(started(setup, address))
        planner = PlannerLoop(
            thinker,
            link,
            operator,
            sink,
            MonotonicClock(),
            process.is_alive,
            setup.stays,
            stands=not setup.simulated,
        )
        guard = Guard(process, spare, lambda: planner.quitting)
        summary = planner.run(on_tick)
        end(process, planner)
        guard.join()
        _explain(process, guard, summary)
        return summary


@contextmanager
def started(setup: LiveSetup, address: str) -> Iterator[BaseProcess]:
    """The control process, which has ended afterwards whatever happens."""
    control = ControlSetup(address, setup.hardware, setup.controller, setup.limits, os.getpid())
    process = multiprocessing.get_context("spawn").Process(
        target=control_process, args=(control,), name="egovcp-control"
    )
    with inherited_by_workers():
        process.start()
    try:
        yield process
    finally:
        if process.is_alive():
            process.terminate()
            process.join(END_S)
        if process.is_alive():
            process.kill()
            process.join()


def _explain(process: BaseProcess, guard: Guard, summary: LiveSummary) -> None:
    if guard.acted and summary.ticks:
        summary.damped = f"the control process died (exit code {process.exitcode})"
        return
    if not summary.ticks and summary.failure is None:
        raise EnvironmentFailure(
            f"the control process ended with code {process.exitcode} before the robot was ready; "
            "its own message is above. egovcp-deploy --dry_run=true checks robot and camera"
        )
