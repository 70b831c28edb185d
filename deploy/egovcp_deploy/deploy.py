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
from egovcp_deploy import dry_run
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.live.drive import check_live, drive, drive_simulated
from egovcp_deploy.live.preflight import examine_hardware
from egovcp_deploy.options import (
    PLANNER,
    REFERENCES,
    check_choice,
    check_output_dir,
)
from egovcp_deploy.robots.replay import open_recordings
from egovcp_deploy.rollouts import make_robot, play_rollouts, replay
from egovcp_deploy.scenarios import held_out

PROG: Final = "egovcp-deploy"
SIM: Final = "sim"
REPLAY: Final = "replay"
ROBOTS: Final = (SIM, "unitree_g1", REPLAY)
DRIVERS: Final = (PLANNER, *REFERENCES)
_EPILOG: Final = (
    "In simulation rollout i plays held-out scenario i of --seed, the same that egovcp-eval plays. "
    "Writes rollout-<i>.mcap, rollout-<i>.rrd, a picture rollout-0.png, and deploy.json, which "
    "sums up the rollouts that came to their end, also when the others were interrupted. On a "
    "robot the first Ctrl-C holds it, the second damps its motors: a standing robot sinks. Exit "
    "code 6: the motors were damped for safety."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(DeployConfig, deploy, argv, prog=PROG, epilog=_EPILOG)


def deploy(config: DeployConfig) -> None:
    """Check everything, then drive the robot and record it.

    Raises:
        UsageError: an option makes no sense, or the folder holds results.
        ArtifactError: the artifact is missing, damaged, or not made for this robot.
        EnvironmentFailure: simulator, robot, camera or disk fail.
        SafetyStop: the motors were damped for safety.
    """
    _check(config)
    if config.dry_run:
        dry_run.conclude(_findings(config))
        return
    planned = config.controller == PLANNER
    artifact = load_policy(config.policy, config.planner) if planned else None
    if config.robot.type == SIM and not config.realtime:
        play_rollouts(config, artifact)
        return
    assert artifact is not None, "checked: all else is driven by the planner"
    if config.robot.type == REPLAY:
        replay(config, artifact)
    elif config.robot.type == SIM:
        drive_simulated(config, artifact)
    else:
        drive(config, artifact)


def _check(config: DeployConfig) -> None:
    check_choice("--task", config.task, EPISODE_TASKS)
    check_choice("--robot.type", config.robot.type, ROBOTS)
    check_choice("--controller", config.controller, DRIVERS)
    held_out(config.task, config.seed, 0)
    if config.controller == PLANNER:
        config.policy.require("choose a reference that needs none, such as --controller=oracle")
    elif config.robot.type != SIM or config.realtime:
        raise UsageError(
            f"--controller={config.controller} needs the simulator in lock-step; on the wall clock "
            "and in a replay there is the planner only"
        )
    if config.realtime and config.robot.type != SIM:
        raise UsageError(
            f"--realtime is for --robot.type=sim; --robot.type={config.robot.type} knows one pace"
        )
    if config.robot.type == REPLAY and not config.robot.recordings:
        raise UsageError(
            "--robot.recordings is missing; name an MCAP file, a folder of them, or a dataset"
        )
    if config.robot.type == SIM:
        require_packages("egovcp-deploy", "--robot.type=sim", *SIMULATOR_MODULES)
    if config.imagine < 0:
        raise UsageError(f"--imagine={config.imagine}: expected a number of ticks from 0")
    check_live(config)
    check_output_dir(config.output_dir)


def _findings(config: DeployConfig) -> Iterator[dry_run.Finding]:
    """All that a run needs, each looked at even if another fails."""
    yield dry_run.examine("disk", lambda: dry_run.disk(Path(config.output_dir)))
    artifact: Artifact | None = None
    if config.controller == PLANNER:
        try:
            artifact = load_policy(config.policy, config.planner)
        except EgovcpError as error:
            yield dry_run.Finding("policy", "", error)
        else:
            made_for = f"{artifact.path}, for the controller {artifact.controller_id}"
            policy = artifact.make_policy(1, config.seed)
            yield dry_run.Finding("policy", made_for)
            yield dry_run.examine("planner", lambda: dry_run.plan_time(policy))
    if config.robot.type == SIM:
        yield dry_run.examine("robot", lambda: _simulated(config, artifact))
    elif config.robot.type == REPLAY:
        yield dry_run.examine("recordings", lambda: _recorded(config, artifact))
    else:
        yield from examine_hardware(config, artifact)


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
