"""`egovcp-deploy` on the wall clock: a G1, or `egovcp-fake-g1`, behind LeRobot's bridge."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from egovcp.artifact import Artifact
from egovcp.errors import EgovcpError, EnvironmentFailure, SafetyStop
from egovcp.files import write_json
from egovcp.hardware import available_cores
from egovcp.log.tick import Tick
from egovcp.rate import MonotonicClock
from egovcp.robot.controllers import make_controller
from egovcp.terminal import echo, one_line
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.live.operators import open_operator
from egovcp_deploy.live.planner_loop import (
    START_S,
    LiveSummary,
    PlannerLoop,
    describe_failure,
)
from egovcp_deploy.live.processes import running_control, stop_control
from egovcp_deploy.options import make_output_dir
from egovcp_deploy.pilot.planner import PlannerRunner, backend_of
from egovcp_deploy.recording import (
    missing_ticks,
    open_viewer,
    percentiles,
    print_viewer_command,
    provenance,
    recording,
    run_info,
)


def drive(config: DeployConfig, artifact: Artifact) -> None:
    """One run of a robot, recorded as rollout 0; raises as `deploy`."""
    robot = config.robot
    controller_id = make_controller(robot.controller).id
    artifact.require_controller(controller_id)
    folder = make_output_dir(config.output_dir)
    stays = not (config.operator.type == "auto" and config.operator.duration)
    if "OMP_NUM_THREADS" not in os.environ:
        # The control process and the logs need a core: planning threads that wait for one that was
        # preempted are slower than fewer threads.
        torch.set_num_threads(max(1, available_cores() - 1))
    policy = artifact.make_policy(1, config.seed)
    runner = PlannerRunner(policy, config.imagine)
    runner.warm_up()
    info = run_info(config, controller_id, artifact, backend_of(policy))
    try:
        with (
            open_operator(config.operator) as operator,
            open_viewer(config.log) as viewer,
            recording(folder, info, config.log, viewer, blocking=False) as sink,
            tqdm(unit="tick", desc="live") as bar,
            running_control(robot) as control,
        ):
            process, watchdog, clock = control.process, control.watchdog, MonotonicClock()
            loop = PlannerLoop(runner, control.link, operator, sink, clock, process.is_alive, stays)
            watchdog.expected = lambda: loop.quitting
            summary = loop.run(lambda tick: _show(bar, tick))
            silent = not (summary.ticks or summary.failure or loop.quitting)
            died = not process.is_alive()
            stop_control(process, loop)
            watchdog.join_if_ended()
            if silent and died:
                control.check_alive()
            if silent:
                raise EnvironmentFailure(
                    f"no observation arrived within {START_S:g} s; egovcp-deploy --dry_run=true "
                    "checks robot and camera"
                )
            if watchdog.acted and summary.ticks:
                summary.damped = f"the control process died (exit code {process.exitcode})"
    except EgovcpError:
        for path in folder.glob("rollout-0.*"):  # so that the same command can be repeated
            path.unlink()
        raise
    report: dict[str, Any] = {
        "robot": robot.type,
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
        **provenance(info),
    }
    write_json(folder / "deploy.json", report)
    skipped = f"; {summary.skipped} observations skipped" if summary.skipped else ""
    echo(
        f"{summary.ticks} steps, {summary.running} running, {summary.held} held; observation to "
        f"plan {report['latency_ms_p50']:.0f} ms, p99 {report['latency_ms_p99']:.0f}, "
        f"{summary.late} late; plans computed by {info.backend}{skipped}"
    )
    print_viewer_command(folder / "rollout-0.rrd")
    _raise_failure(summary, folder)


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
        raise SafetyStop(
            f"the planner failed and the robot was held: {describe_failure(summary.failure)}. The "
            f"log is in {folder}; --debug prints the traceback"
        ) from summary.failure


def _show(bar: Any, tick: Tick) -> None:
    for event in tick.events:
        bar.write(one_line(f"{tick.time_ns / 1e9:8.2f} s  {event}"))
    plan = f", plan {tick.timing_ms['plan']:.0f} ms" if "plan" in tick.timing_ms else ""
    bar.set_postfix_str(f"{tick.mode}{plan}", refresh=False)
    bar.update(1)
