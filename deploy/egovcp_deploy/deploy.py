"""`egovcp-deploy`: close the loop with a policy and record every rollout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.policy_options import load_policy
from egovcp.sim.tasks.registry import DEFAULT_TASK, find_task
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.dry_run import dry_run
from egovcp_deploy.live.drive import drive
from egovcp_deploy.options import PLANNER, check_output_dir
from egovcp_deploy.recording import print_viewer_command
from egovcp_deploy.robots.realsense_camera import require_realsense
from egovcp_deploy.rollouts import play_rollouts, replay

PROG: Final = "egovcp-deploy"
_EPILOG: Final = (
    "In simulation rollout i plays held-out scenario i of --seed, the same that egovcp-eval plays. "
    "Writes rollout-<i>.mcap, rollout-<i>.rrd, PNG and GIF of the first rollouts (not of a live "
    "run), and deploy.json, which summarises the complete rollouts, also after an interrupt. On a "
    "robot the first Ctrl-C holds it, the second damps its motors: a standing robot collapses to "
    "the floor. With --operator.duration the first one also ends the run, 2 s later. Exit code 6: "
    "the robot was held or damped because something failed."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(DeployConfig, deploy, argv, prog=PROG, epilog=_EPILOG)


def deploy(config: DeployConfig) -> None:
    """Check everything, then drive the robot and record it. Raises `UsageError` (options, folder),
    `ArtifactError`, `EnvironmentFailure` (simulator, robot, camera, disk) or `SafetyStop`."""
    if config.robot.type == "sim" and not config.task:
        config = replace(config, task=DEFAULT_TASK)
    check_options(config)
    if config.dry_run:
        dry_run(config)
        return
    planned = config.controller == PLANNER
    artifact = load_policy(config.policy, config.planner) if planned else None
    if config.robot.type == "sim":
        print_viewer_command(play_rollouts(config, artifact) / "rollout-0.rrd")
        return
    assert artifact is not None, "checked: only the simulator runs without the planner"
    if config.robot.type == "replay":
        print_viewer_command(replay(config, artifact) / "rollout-0.rrd")
    else:
        drive(config, artifact)


def check_options(config: DeployConfig) -> None:
    """Raise `UsageError` or `EnvironmentFailure` for what can be known before any work starts."""
    robot = config.robot.type
    if config.controller == PLANNER:
        reference = "choose a reference that needs none, such as --controller=oracle"
        config.policy.require(reference if robot == "sim" else "")
    elif robot != "sim":
        raise UsageError(
            f"--controller={config.controller} needs --robot.type=sim; only the planner can be "
            f"used with --robot.type={robot}"
        )
    if config.dry_run and robot != "unitree_g1":
        raise UsageError(f"--dry_run checks a robot; expected --robot.type=unitree_g1, not {robot}")
    if robot == "replay" and not config.robot.recordings:
        raise UsageError("--robot.recordings is missing; name an MCAP file, or a folder of them")
    if robot == "sim":
        require_packages("egovcp-deploy", "--robot.type=sim", *SIMULATOR_MODULES)
        find_task(config.task, "--task")
    if robot == "unitree_g1" and config.robot.camera.type == "realsense":
        require_realsense(config.robot.camera.realsense)
    if config.operator.type == "keyboard" and config.operator.duration:
        raise UsageError(
            f"--operator.duration={config.operator.duration:g} needs --operator.type=remote or "
            "auto; with keyboard, press h to hold the robot, and q to damp it and quit"
        )
    if config.output_dir or not config.dry_run:  # a dry run writes nothing
        check_output_dir(config.output_dir)
