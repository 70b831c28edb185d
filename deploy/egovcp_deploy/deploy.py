"""`egovcp-deploy`: close the loop with a policy and record every rollout."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from egovcp.artifact import Artifact
from egovcp.cli import run_command
from egovcp.errors import EgovcpError, UsageError
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.policy_options import load_policy
from egovcp.sim.scenario import EPISODE_TASKS
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.dry_run import (
    CheckResult,
    check,
    check_disk,
    check_hardware,
    check_plan_time,
    conclude,
)
from egovcp_deploy.live.drive import drive, drive_simulated
from egovcp_deploy.options import PLANNER, check_choice, check_output_dir, held_out
from egovcp_deploy.robots.realsense_camera import require_realsense
from egovcp_deploy.robots.replay import open_recordings
from egovcp_deploy.rollouts import make_robot, play_rollouts, replay

PROG: Final = "egovcp-deploy"
_EPILOG: Final = (
    "In simulation rollout i plays held-out scenario i of --seed, the same that egovcp-eval plays. "
    "Writes rollout-<i>.mcap, rollout-<i>.rrd, a picture rollout-0.png, and deploy.json, which "
    "summarises the complete rollouts, also after an interrupt. On a robot the first Ctrl-C holds "
    "it, the second damps its motors: a standing robot sinks. Exit code 6: the motors were damped "
    "for safety."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(DeployConfig, deploy, argv, prog=PROG, epilog=_EPILOG)


def deploy(config: DeployConfig) -> None:
    """Check everything, then drive the robot and record it.

    Raises:
        UsageError: an option is wrong, or the folder holds results.
        ArtifactError: the artifact is missing, damaged, or not made for this robot.
        EnvironmentFailure: simulator, robot, camera or disk fail.
        SafetyStop: the motors were damped for safety.
    """
    _check(config)
    if config.dry_run:
        conclude(_dry_run_checks(config))
        return
    planned = config.controller == PLANNER
    artifact = load_policy(config.policy, config.planner) if planned else None
    if config.robot.type == "sim" and not config.realtime:
        play_rollouts(config, artifact)
        return
    assert artifact is not None, "checked: only lock-step simulation runs without the planner"
    run = {"replay": replay, "sim": drive_simulated, "unitree_g1": drive}
    run[config.robot.type](config, artifact)


def _check(config: DeployConfig) -> None:
    robot = config.robot.type
    check_choice("--task", config.task, EPISODE_TASKS)
    held_out(config.task, config.seed, 0)
    if config.controller == PLANNER:
        config.policy.require("choose a reference that needs none, such as --controller=oracle")
    elif robot != "sim" or config.realtime:
        raise UsageError(
            f"--controller={config.controller} needs the simulator in lock-step; on the wall clock "
            "and in a replay only the planner can be used"
        )
    if config.realtime and robot != "sim":
        raise UsageError(
            f"--realtime is for --robot.type=sim; --robot.type={robot} has one pace only"
        )
    if robot == "replay" and not config.robot.recordings:
        raise UsageError(
            "--robot.recordings is missing; name an MCAP file, a folder of them, or a dataset"
        )
    if robot == "sim":
        require_packages("egovcp-deploy", "--robot.type=sim", *SIMULATOR_MODULES)
    if config.robot.camera.type == "realsense":
        require_realsense()
    check_output_dir(config.output_dir)


def _dry_run_checks(config: DeployConfig) -> Iterator[CheckResult]:
    """All checks; a failed one does not prevent the others."""
    yield check("disk", lambda: check_disk(Path(config.output_dir)))
    artifact: Artifact | None = None
    if config.controller == PLANNER:
        try:
            artifact = load_policy(config.policy, config.planner)
        except EgovcpError as error:
            yield CheckResult("policy", "", error)
        else:
            made_for = f"{artifact.path}, for the controller {artifact.controller_id}"
            policy = artifact.make_policy(1, config.seed)
            yield CheckResult("policy", made_for)
            yield check("planner", lambda: check_plan_time(policy))
    if config.robot.type == "sim":
        yield check("robot", lambda: _simulated(config, artifact))
    elif config.robot.type == "replay":
        yield check("recordings", lambda: _recorded(config, artifact))
    else:
        yield from check_hardware(config, artifact)


def _simulated(config: DeployConfig, artifact: Artifact | None) -> str:
    robot = make_robot(config)
    try:
        if artifact is not None:
            artifact.require_controller(robot.controller_id)
        robot.start(0)
        robot.observe()
        return f"simulated, with the controller {robot.controller_id}"
    finally:
        robot.close()


def _recorded(config: DeployConfig, artifact: Artifact | None) -> str:
    robot = open_recordings(Path(config.robot.recordings))
    if artifact is not None:
        artifact.require_controller(robot.controller_id)
    return f"{robot.count}, of a robot with the controller {robot.controller_id}"


if __name__ == "__main__":
    raise SystemExit(main())
