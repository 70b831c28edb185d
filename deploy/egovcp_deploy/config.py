"""Options of `egovcp-deploy`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import draccus

from egovcp.bounds import bounded
from egovcp.policy_options import PlannerOptions, PolicyOptions
from egovcp.robot.controllers import absolute_controller
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp_deploy.live.gamepad import GamepadOptions
from egovcp_deploy.live.hardware import CameraOptions
from egovcp_deploy.options import PLANNER, absolute_path
from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.recording import LogOptions
from egovcp_deploy.robots.bridge import BridgeConfig


@dataclass(frozen=True)
class RobotOptions:
    """Which robot."""

    type: str = "sim"
    """sim: the simulated G1, in lock-step with the planner, or with --realtime on the wall clock.
    unitree_g1: a G1, or egovcp-fake-g1, behind LeRobot's bridge, on the wall clock. replay: what
    was recorded once; the policy watches it again, and nothing is driven."""
    recordings: str = ""
    """Of a replay: an MCAP file, a folder of them, or a LeRobot dataset on disk."""
    controller: str = "walk"
    """Low-level controller of a unitree_g1: walk, stance, or the file of a trained one; the one of
    the policy's data. The simulated robot has --env.controller."""
    bridge: BridgeConfig = field(default_factory=BridgeConfig)
    """Where the bridge of a unitree_g1 is."""
    camera: CameraOptions = field(default_factory=CameraOptions)
    """The depth camera of a unitree_g1."""
    limits: Limits = field(default_factory=Limits)
    """When the robot is held, and when its motors are damped."""


@dataclass(frozen=True)
class OperatorOptions:
    """Who says when to stand, arm, run, hold and stop; on a G1 its remote control always may."""

    type: str = "auto"
    """auto: stands up, arms and runs by itself. keyboard: the keys of this terminal. gamepad: one
    at this machine, on Linux."""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What auto asks for while running: vx, vy (m/s), yaw rate (rad/s)."""
    duration: float = bounded(0.0, least=0)
    """How long auto runs before it holds and ends, s; 0: until interrupted."""
    gamepad: GamepadOptions = field(default_factory=GamepadOptions)
    """Which gamepad, and which of its buttons does what."""


@dataclass(frozen=True)
class DeployConfig:
    """Drive a robot with a policy artifact at 25 Hz and record each rollout.

    --controller=oracle shows how a task is solved, with no artifact at all.
    """

    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The policy artifact; not needed without the controller `planner`."""
    controller: str = PLANNER
    """Who drives: planner, or in simulation a reference that needs no artifact: hold (neutral
    pose), random (the paper's walk) or oracle (scripted, sees the truth)."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the artifact's planner."""
    robot: RobotOptions = field(default_factory=RobotOptions)
    """The robot."""
    operator: OperatorOptions = field(default_factory=OperatorOptions)
    """Who drives a unitree_g1."""
    realtime: bool = False
    """Run the simulated robot on the wall clock, behind the same wire as a real one."""
    dry_run: bool = False
    """Only check what a run needs, line by line, and say go or no-go; nothing moves."""
    task: str = "ball"
    """Scene of the simulated robot: ball, wall, arch, or sequence (several in one episode,
    --env.sequence.parts). The policy is not told."""
    episodes: int = bounded(3, least=1, most=1_000_000)
    """Number of rollouts."""
    seed: int = bounded(0, least=0)
    """Which held-out scenarios."""
    output_dir: str = ""
    """New folder for recordings and summary."""
    log: LogOptions = field(default_factory=LogOptions)
    """What is recorded, and shown live."""
    imagine: int = bounded(16, least=0, most=1000)
    """How far ahead the world model imagines depth for the recordings, ticks of 40 ms; 0: not at
    all."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation of the simulated robot."""

    def encoded(self) -> dict[str, Any]:
        """The options as they are recorded: JSON values, with absolute paths."""
        robot = replace(
            self.robot,
            recordings=absolute_path(self.robot.recordings),
            controller=absolute_controller(self.robot.controller),
        )
        config = replace(
            self,
            policy=replace(self.policy, path=absolute_path(self.policy.path)),
            robot=robot,
            output_dir=absolute_path(self.output_dir),
        )
        options: dict[str, Any] = draccus.encode(config)
        return options
