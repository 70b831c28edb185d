"""`egovcp-deploy` on the wall clock: a G1, or `egovcp-fake-g1`, behind LeRobot's bridge."""

from __future__ import annotations

import signal
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np

from egovcp.artifact import Artifact
from egovcp.errors import EgovcpError, EnvironmentFailure, SafetyStop
from egovcp.files import write_json
from egovcp.log.tick import RunInfo, Sink
from egovcp.rate import MonotonicClock
from egovcp.robot.controllers import make_controller
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.live.display import Display
from egovcp_deploy.live.operators import open_operator
from egovcp_deploy.live.planner_loop import (
    START_S,
    LiveSummary,
    PlannerLoop,
    describe_failure,
)
from egovcp_deploy.live.processes import running_control, stop_control
from egovcp_deploy.options import make_output_dir
from egovcp_deploy.pilot.planner import PlannerRunner, backend_of, leave_core
from egovcp_deploy.recording import (
    make_run_info,
    missing_ticks,
    open_viewer,
    percentiles,
    print_viewer_command,
    provenance_fields,
    recording,
)


def drive(config: DeployConfig, artifact: Artifact) -> None:
    """One run of a robot, recorded as rollout 0; raises as `deploy`."""
    robot = config.robot
    controller_id = make_controller(robot.controller).id
    artifact.require_controller(controller_id)
    folder = make_output_dir(config.output_dir)
    stays = not config.operator.duration
    leave_core()
    policy = artifact.make_policy(1, config.seed)
    runner = PlannerRunner(policy, config.imagine)
    runner.warm_up()
    info = make_run_info(config, controller_id, artifact, backend_of(policy))
    with ExitStack() as signals:
        try:
            with (
                open_operator(config.operator) as operator,
                open_viewer(config.log) as viewer,
                closing(Display()) as display,
                recording(folder, info, config.log, viewer, False, warn=display.warn) as sink,
                running_control(robot) as control,
            ):
                # Another Ctrl-C must not end the program before the logs are complete.
                interrupts = signals.enter_context(stop_on_signal((signal.SIGINT,), False))
                process, watchdog = control.process, control.watchdog
                loop = PlannerLoop(
                    runner,
                    control.link,
                    operator,
                    sink,
                    MonotonicClock(),
                    process.is_alive,
                    stays,
                    process.kill,
                    display.warn,
                )
                watchdog.expected = lambda: loop.quitting
                summary = loop.run(display.show)
                silent = not (summary.ticks or summary.failure or loop.quitting)
                died = not process.is_alive()
                stop_control(process, watchdog, interrupts)
                if loop.interrupts and not (summary.ticks or summary.failure):
                    raise KeyboardInterrupt
                if silent and died:
                    control.check_alive()
                if silent:
                    raise EnvironmentFailure(
                        f"no observation arrived within {START_S:g} s; egovcp-deploy "
                        "--dry_run=true checks robot and camera"
                    )
                if watchdog.acted and summary.ticks:
                    summary.damped = f"the control process died (exit code {process.exitcode})"
        except (EgovcpError, KeyboardInterrupt):  # the latter only before the first observation
            for path in folder.glob("rollout-0.*"):  # so that the same command can be repeated
                path.unlink()
            raise
        report = _report(summary, sink, info, robot.type)
        write_json(folder / "deploy.json", report)
    skipped = f"; {summary.skipped} observations skipped" if summary.skipped else ""
    echo(
        f"{summary.ticks} steps, {summary.running} running, {summary.held} held; observation to "
        f"plan {report['latency_ms_p50']:.0f} ms, p99 {report['latency_ms_p99']:.0f}, "
        f"{summary.late} late; plans computed by {info.backend}{skipped}"
    )
    print_viewer_command(folder / "rollout-0.rrd")
    _raise_failure(summary, folder)


def _report(summary: LiveSummary, sink: Sink, info: RunInfo, robot: str) -> dict[str, Any]:
    """The content of ``deploy.json``; ``sink`` is closed."""
    return {
        "robot": robot,
        "ticks": summary.ticks,
        "ticks_running": summary.running,
        "ticks_held": summary.held,
        "plans": summary.planned,
        "plans_late": summary.late,
        "skipped_observations": summary.skipped,
        **percentiles("plan_ms", summary.plan_ms),
        **percentiles("latency_ms", summary.latency_ms),
        "iterations_mean": float(np.mean(summary.iterations or [0])),
        "missing_ticks": missing_ticks(sink),
        "damped": summary.damped,
        "failure": "" if summary.failure is None else describe_failure(summary.failure),
        "events": summary.events,
        **provenance_fields(info),
    }


def _raise_failure(summary: LiveSummary, folder: Path) -> None:
    """Raise what ended the run early, if anything."""
    if summary.damped:
        raise SafetyStop(
            f"the motors were damped: {summary.damped}. The log is in {folder}; look into it "
            "before the next run"
        ) from summary.failure
    if isinstance(summary.failure, EgovcpError) and not summary.held:
        raise summary.failure
    if summary.failure is not None:
        held = " and the robot was held" if summary.held else ""
        raise SafetyStop(
            f"the planner failed{held}: {describe_failure(summary.failure)}. The log is in "
            f"{folder}; --debug prints the traceback"
        ) from summary.failure
