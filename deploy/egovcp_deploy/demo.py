"""`egovcp-demo`: play a policy in simulation, by default the one that ships with egovcp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from egovcp.bounds import bounded
from egovcp.cli import run_command
from egovcp.log.rollout_video import AHEAD
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.policy_options import PlannerOptions, PolicyOptions, load_policy
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp.terminal import echo
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.deploy import check_options
from egovcp_deploy.options import SEEDS
from egovcp_deploy.recording import LogOptions, print_viewer_command
from egovcp_deploy.rollouts import play_rollouts

PROG: Final = "egovcp-demo"
_EPILOG: Final = (
    "Writes rollout.gif (depth image, imagined image and robot), rollout.rrd (Rerun), rollout.mcap "
    "(Foxglove), rollout.png, and rollout.mp4 if PyAV is installed."
)


@dataclass(frozen=True)
class DemoConfig:
    """Play one simulated episode with a trained policy, and record it.

    The robot ducks under an arch, blocks a ball and braces on a wall. egovcp-deploy has more
    options.
    """

    policy: PolicyOptions = field(default_factory=lambda: PolicyOptions("contact"))
    """The policy."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the policy's planner."""
    task: str = "sequence"
    """Scene: sequence (arch, ball and wall in turn), or another name from `egovcp-task list`."""
    seed: int = bounded(0, least=0, below=SEEDS)
    """Seed of the held-out scenario and of the planner's sampling."""
    live: str = ""
    """Also show the episode as it is played: web (a page for browsers), or spawn (the Rerun
    viewer)."""
    output_dir: str = "outputs/demo"
    """New folder for the recordings."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation of the simulated robot."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(DemoConfig, demo, argv, prog=PROG, epilog=_EPILOG)


def demo(config: DemoConfig) -> None:
    """Play, record, and name the files. Raises as `egovcp_deploy.deploy.deploy`."""
    require_packages("egovcp-deploy", PROG, *SIMULATOR_MODULES, "matplotlib")
    config.policy.require()
    rollout = DeployConfig(
        policy=config.policy,
        planner=config.planner,
        task=config.task,
        episodes=1,
        seed=config.seed,
        output_dir=config.output_dir,
        log=LogOptions(live=config.live),
        imagine=AHEAD,
        env=config.env,
    )
    check_options(rollout)
    folder = play_rollouts(rollout, load_policy(config.policy, config.planner))
    (folder / "deploy.json").unlink()  # it names the files as egovcp-deploy does
    for path in sorted(folder.glob("rollout-0.*")):
        path.rename(folder / f"rollout{path.suffix}")
    echo(f"video: {folder / 'rollout.gif'}")
    print_viewer_command(folder / "rollout.rrd")
