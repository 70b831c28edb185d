"""Options of `egovcp-deploy`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from egovcp.bounds import bounded
from egovcp.policy_options import PlannerOptions, PolicyOptions
from egovcp.robot.controllers import absolute_controller
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp_deploy.live.hardware import RobotOptions
from egovcp_deploy.options import SEEDS, encoded
from egovcp_deploy.recording import LogOptions


@dataclass(frozen=True)
class OperatorOptions:
    """Source of the requests to stand, arm, run, hold and stop; the remote control of a G1 works in
    addition."""

    type: Literal["remote", "keyboard", "auto"] = "remote"
    """remote: only the robot's remote control starts it; keyboard: the keys of this terminal; auto:
    stands up, arms and runs by itself, for egovcp-fake-g1."""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Velocity of auto while running: vx, vy (m/s), yaw rate (rad/s)."""
    duration: float = bounded(0.0, least=0)
    """Time from RUN until the robot is held and the run ends, s; 0: until interrupted. Not for
    keyboard."""


@dataclass(frozen=True)
class DeployConfig:
    """Drive a robot with a policy at the rate of its planner and record each rollout."""

    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The policy; only for the controller `planner`."""
    controller: Literal["planner", "hold", "random", "oracle"] = "planner"
    """What drives the robot: planner, or in simulation a reference without a policy: hold
    (neutral pose), random (the paper's walk) or oracle (scripted, uses the simulator's state)."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the policy's planner."""
    robot: RobotOptions = field(default_factory=RobotOptions)
    """The robot."""
    operator: OperatorOptions = field(default_factory=OperatorOptions)
    """The operator of a unitree_g1."""
    dry_run: bool = False
    """Only check what a run of a unitree_g1 needs, and print go or no-go per check; nothing
    moves."""
    task: str = ""
    """Scene of the simulated robot: a name from `egovcp-task list`, such as ball (if empty) or
    sequence (several in one episode, --env.sequence.parts), or package.module:Class; of a real
    robot only recorded. It is no input of the policy."""
    episodes: int = bounded(3, least=1, most=1_000_000)
    """Rollouts in simulation, or recordings to replay; a unitree_g1 makes one."""
    seed: int = bounded(0, least=0, below=SEEDS)
    """Seed of the planner's sampling and, in simulation, of the held-out scenarios."""
    output_dir: str = ""
    """New folder for recordings and summary."""
    log: LogOptions = field(default_factory=LogOptions)
    """Logs besides the MCAP file."""
    imagine: int = bounded(16, least=0, most=1000)
    """Horizon of the predicted depth images in the recordings, planner steps (of 40 ms for the G1);
    0: none."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation of the simulated robot."""

    def encoded(self) -> dict[str, Any]:
        """The options as JSON values, with absolute paths."""
        options = encoded(self, "policy.path", "robot.recordings", "output_dir")
        options["robot"]["controller"] = absolute_controller(self.robot.controller)
        return options
