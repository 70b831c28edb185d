"""`egovcp-deploy` on the wall clock: a G1 behind LeRobot's bridge, or the fake of one."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from tqdm import tqdm

from egovcp.artifact import Artifact
from egovcp.errors import EgovcpError, SafetyStop, UsageError
from egovcp.files import write_json
from egovcp.hardware import available_cores
from egovcp.log.tick import CameraView, RunInfo, Tick
from egovcp.robot.controllers import make_controller
from egovcp.terminal import echo, one_line
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.live.hardware import CAMERAS, REALSENSE, HardwareOptions
from egovcp_deploy.live.operators import OPERATORS, operator
from egovcp_deploy.live.planner import LiveSummary, failure_words
from egovcp_deploy.live.run import LiveSetup, run_live
from egovcp_deploy.live.simulated import simulated
from egovcp_deploy.options import check_choice, make_output_dir
from egovcp_deploy.pilot.desk import Thinker
from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.policy import backend_of
from egovcp_deploy.recording import missing_ticks, recording, run_info
from egovcp_deploy.robots.realsense_camera import require_realsense

SIMULATED_S: Final = 15.0  # in RUN: the crane lets go, the robot settles, the episode


def check_live(config: DeployConfig) -> None:
    """Refuse options that make no sense on the wall clock.

    Raises:
        UsageError: names the option.
        MissingPackage: the driver of the camera is not installed.
    """
    check_choice("--operator.type", config.operator.type, OPERATORS)
    check_choice("--robot.camera.type", config.robot.camera.type, CAMERAS)
    if config.robot.camera.type == REALSENSE:
        require_realsense()
    if not np.isfinite(config.operator.velocity).all():
        raise UsageError(f"--operator.velocity={config.operator.velocity}: expected numbers")
    if not config.operator.duration >= 0:
        raise UsageError(f"--operator.duration={config.operator.duration}: expected s from 0")


def drive(config: DeployConfig, artifact: Artifact) -> None:
    """One run of a robot, recorded as rollout 0.

    Raises:
        ArtifactError: the artifact is not made for the low-level controller.
        EnvironmentFailure: robot, camera or disk fail.
        SafetyStop: the motors were damped for safety.
    """
    hardware = HardwareOptions(config.robot.bridge, config.robot.camera)
    folder = _prepare(config, artifact)
    stays = config.operator.type != "auto" or not config.operator.duration
    _run(config, artifact, folder, LiveSetup(hardware, *_how(config), stays))


def drive_simulated(config: DeployConfig, artifact: Artifact) -> None:
    """The same with the simulator on the wall clock, for one episode.

    Raises:
        ArtifactError, EnvironmentFailure, SafetyStop: as `drive`.
    """
    operator_options = config.operator
    if operator_options.type == "auto" and not operator_options.duration:
        operator_options = replace(operator_options, duration=SIMULATED_S)
    robot = replace(config.robot, controller=config.env.controller)
    config = replace(config, robot=robot, operator=operator_options)
    folder = _prepare(config, artifact)
    with simulated(config, folder / "task.json") as hardware:
        _run(config, artifact, folder, LiveSetup(hardware, *_how(config), False, simulated=True))


def _prepare(config: DeployConfig, artifact: Artifact) -> Path:
    artifact.require_controller(make_controller(config.robot.controller).id)
    return make_output_dir(config.output_dir)


def _how(config: DeployConfig) -> tuple[str, Limits]:
    return config.robot.controller, config.robot.limits


def _run(config: DeployConfig, artifact: Artifact, folder: Path, setup: LiveSetup) -> None:
    controller_id = make_controller(setup.controller).id
    _leave_a_core()
    policy = artifact.make_policy(1, config.seed)
    thinker = Thinker(policy, config.imagine)
    thinker.warm_up()
    info = run_info(
        config.task,
        config.seed,
        0,
        CameraView(),
        config.encoded(),
        controller_id,
        artifact,
        backend_of(policy),
    )
    try:
        summary = _drive(config, folder, setup, thinker, info)
    except EgovcpError:
        _clear(folder)
        raise
    write_json(folder / "deploy.json", _report(config, artifact, info, summary))
    _print(summary, info.backend, folder)
    _judge(summary, folder)


def _drive(
    config: DeployConfig, folder: Path, setup: LiveSetup, thinker: Thinker, info: RunInfo
) -> LiveSummary:
    options = config.operator
    with (
        operator(options.type, options.velocity, options.duration, options.gamepad) as who,
        recording(folder, 0, info, config.log, waits=False) as sink,
        tqdm(unit="tick", desc="live") as bar,
    ):
        summary = run_live(setup, thinker, who, sink, lambda tick: _show(bar, tick))
    summary.missing_ticks = missing_ticks(sink)
    return summary


def _clear(folder: Path) -> None:
    """Take back the logs of a run that did not begin, so that the same command can be repeated."""
    for path in folder.glob("rollout-0.*"):
        path.unlink()


def _judge(summary: LiveSummary, folder: Path) -> None:
    """Raise what kept the run from coming to its own end."""
    if summary.damped:
        raise SafetyStop(
            f"the motors were damped: {summary.damped}. The log is in {folder}; "
            "find the cause before the next run"
        ) from summary.failure
    if isinstance(summary.failure, EgovcpError):
        raise summary.failure
    if summary.failure is not None:
        raise SafetyStop(
            f"the planner failed and the robot was held: {failure_words(summary.failure)}. The log "
            f"is in {folder}; --debug prints the traceback"
        ) from summary.failure


def _leave_a_core() -> None:
    """Plan on all cores but one, which the control process and the logs need: threads that wait
    for one that was put aside plan slower than fewer threads."""
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(max(1, available_cores() - 1))


def _show(bar: Any, tick: Tick) -> None:
    for event in tick.events:
        bar.write(one_line(f"{tick.time_ns / 1e9:8.2f} s  {event}"))
    plan = f", plan {tick.timing_ms['plan']:.0f} ms" if "plan" in tick.timing_ms else ""
    bar.set_postfix_str(f"{tick.mode}{plan}", refresh=False)
    bar.update(1)


def _report(
    config: DeployConfig, artifact: Artifact, info: RunInfo, summary: LiveSummary
) -> dict[str, Any]:
    """Content of ``deploy.json``."""
    return {
        "robot": config.robot.type,
        "ticks": summary.ticks,
        "ticks_running": summary.running,
        "ticks_held": summary.held,
        "plans": summary.planned,
        "plans_late": summary.late,
        "skipped_observations": summary.skipped,
        **_percentiles("plan_ms", summary.plan_ms),
        **_percentiles("latency_ms", summary.latency_ms),
        "iterations_mean": float(np.mean(summary.iterations or [0])),
        "missing_ticks": summary.missing_ticks,
        "damped": summary.damped,
        "failure": "" if summary.failure is None else failure_words(summary.failure),
        "events": summary.events,
        "config": config.encoded(),
        "artifact": artifact.manifest["files"],
        "low_level_controller": info.hashes["low_level_controller"],
        "backend": info.backend,
        "versions": dict(info.versions),
    }


def _percentiles(name: str, values: list[float]) -> dict[str, float]:
    p50, p99 = np.percentile(values or [0.0], [50, 99])
    return {f"{name}_p50": float(p50), f"{name}_p99": float(p99)}


def _print(summary: LiveSummary, backend: str, folder: Path) -> None:
    latency = _percentiles("ms", summary.latency_ms)
    echo(
        f"{summary.ticks} ticks, {summary.running} running, {summary.held} held; observation to "
        f"plan {latency['ms_p50']:.0f} ms, p99 {latency['ms_p99']:.0f}, {summary.late} late; plans "
        f"computed by {backend}"
        + (f"; {summary.skipped} observations skipped" if summary.skipped else "")
    )
    echo(f"look at it:  rerun {folder / 'rollout-0.rrd'}")
