"""Terms of the low-level task for mjlab, all of which read from one `TaskLogic`.

It runs in numpy on the host, once per tick, on 0.3 kB per robot. `mjlab_task` configures the terms.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, cast

import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers.action_manager import ActionTerm, ActionTermCfg
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.robot.geometry import rotation_matrix
from egovcp.robot.walking import ACTIONS, WalkConfig
from egovcp.sim.config import SensorConfig
from egovcp.spec import CONTROLLER_HZ, JOINT_NAMES
from egovcp_train.lowlevel import physics, rewards
from egovcp_train.lowlevel.commands import random_push
from egovcp_train.lowlevel.config import CurriculumConfig, DisturbanceConfig, LowLevelTask
from egovcp_train.lowlevel.env import TaskLogic
from egovcp_train.lowlevel.learner import next_difficulty
from egovcp_train.lowlevel.physics import HEAD, Snapshot
from egovcp_train.lowlevel.walls import NO_WALL_DISTANCE
from egovcp_train.on_policy import RslRlPpoConfig

ROBOT: Final = "robot"  # name in the scene
LOGIC: Final = "task_logic"  # name of the command term
_FEET: Final = ("left_ankle_roll_link", "right_ankle_roll_link")
_PALMS: Final = ("left_palm", "right_palm")
_NEVER: Final = 1e9  # s; `Commands` has its own intervals

Array = NDArray[np.float64]


@dataclass(kw_only=True)
class TaskLogicTermCfg(CommandTermCfg):
    """Options of the task logic and of its curriculum."""

    resampling_time_range: tuple[float, float] = (_NEVER, _NEVER)
    task: LowLevelTask = field(default_factory=LowLevelTask)
    walk: WalkConfig = field(default_factory=WalkConfig)
    sensors: SensorConfig = field(default_factory=SensorConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    ticks_per_iteration: int = RslRlPpoConfig.num_steps_per_env

    def build(self, env: ManagerBasedRlEnv) -> TaskLogicTerm:
        return TaskLogicTerm(self, env)


class TaskLogicTerm(CommandTerm):
    """`TaskLogic` of all robots as a command term, from which the other terms read."""

    cfg: TaskLogicTermCfg

    def __init__(self, cfg: TaskLogicTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        rng = np.random.default_rng(env.cfg.seed)
        self.logic = TaskLogic(self.num_envs, cfg.task, cfg.walk, cfg.sensors, rng)
        self.robot = MjlabRobot(env)
        self._falls = self._tracked = 0.0
        self._ticks = 0
        self._observations: dict[str, torch.Tensor] = {}
        self._rewards: dict[str, torch.Tensor] = {}

    @property
    def command(self) -> torch.Tensor:
        """(N, 10) v, hands, height."""
        return self._tensor(self.logic.commands.vector)

    def observation(self, group: str) -> torch.Tensor:
        """policy: its input (N, 95); privileged: additional input of the critic (N, 17)."""
        if not self._observations:
            policy, privileged = self.logic.observe(
                self.robot.snapshot(),
                self.robot.friction(),
                np.full(self.num_envs, NO_WALL_DISTANCE),
            )
            self._observations["policy"] = self._tensor(policy)
            self._observations["privileged"] = self._tensor(privileged)
        return self._observations[group]

    def targets(self, action: torch.Tensor) -> torch.Tensor:
        """(N, 15) -> joint targets (N, 29), rad."""
        return self._tensor(self.logic.targets(action.detach().cpu().numpy()))

    def evaluate_tick(self) -> torch.Tensor:
        """Compute the rewards and adapt the difficulty; returns which robots (N,) have fallen.

        Called once per tick, before `reward`.
        """
        x = self.robot.snapshot()
        terms, fell = self.logic.reward_terms(x), self.logic.fallen
        finite = rewards.finite_terms(terms, fell, x.broken)
        self._rewards = {name: self._tensor(value) for name, value in finite.items()}
        self._adapt(fell, finite["velocity"])
        return torch.from_numpy(fell).to(self.device)

    def reward(self, name: str) -> torch.Tensor:
        """(N,) one term of the last tick."""
        return self._rewards[name]

    def _update_metrics(self) -> None:
        """No metrics: mjlab logs the rewards."""

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        self.logic.restart(env_ids.cpu().numpy())

    def _update_command(self, env_ids: torch.Tensor | None) -> None:
        """Once per tick (or reset), with the simulation up to date."""
        if env_ids is None:
            self.logic.commands.advance()
        self._observations = {}

    def _adapt(self, fell: NDArray[np.bool_], velocity: Array) -> None:
        """Apply the curriculum once per iteration of PPO."""
        self._falls += float(fell.mean()) * CONTROLLER_HZ
        self._tracked += float(velocity.mean())
        self._ticks += 1
        if self._ticks == self.cfg.ticks_per_iteration:
            falls, tracked = self._falls / self._ticks, self._tracked / self._ticks
            rule = self.cfg.curriculum
            self.logic.difficulty = next_difficulty(self.logic.difficulty, falls, tracked, rule)
            self._falls = self._tracked = 0.0
            self._ticks = 0

    def _tensor(self, value: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.asarray(value, dtype=np.float32)).to(self.device)


class MjlabRobot:
    """The robots of an mjlab scene, with the state of the CPU environment."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env, self._sim = env, cast("Any", env.sim)
        self._entity = robot = env.scene[ROBOT]
        self.joints, _ = robot.find_joints(JOINT_NAMES, preserve_order=True)
        self._feet, _ = robot.find_bodies(_FEET, preserve_order=True)
        self._palms, _ = robot.find_sites(_PALMS, preserve_order=True)
        self._head = robot.find_geoms(HEAD)[0][0]
        soles, _ = robot.find_geoms(".*_foot.*")
        self._sole = int(robot.indexing.geom_ids[soles[0]])
        model = env.sim.mj_model
        self._radius = float(model.geom_size[robot.indexing.geom_ids[self._head], 0])
        actuators = [model.actuator(i).name.split("/")[-1] for i in range(model.nu)]
        self._actuators = [actuators.index(name) for name in JOINT_NAMES]

    def snapshot(self) -> Snapshot:
        """Positions from each robot's own origin."""
        data = self._entity.data
        origin = _numpy(self._env.scene.env_origins)
        position = _numpy(data.root_link_pos_w) - origin
        joints = _numpy(data.joint_pos[:, self.joints])
        rates = _numpy(data.joint_vel[:, self.joints])
        velocity = _numpy(data.root_link_lin_vel_w)
        finite = [position, joints, rates, velocity]
        broken = ~np.all([np.isfinite(v).all(axis=1) for v in finite], axis=0)
        broken |= np.abs(np.nan_to_num(rates)).max(axis=1) > 100.0
        return Snapshot(
            position=position,
            quaternion=_numpy(data.root_link_quat_w),
            velocity=velocity,
            angular_velocity=_numpy(data.root_link_ang_vel_b),
            joints=joints,
            joint_rates=rates,
            feet=_numpy(data.body_link_pos_w[:, self._feet]) - origin[:, None],
            feet_velocity=_numpy(data.body_link_lin_vel_w[:, self._feet]),
            feet_forward=rotation_matrix(_numpy(data.body_link_quat_w[:, self._feet]))[..., 0],
            palms=_numpy(data.site_pos_w[:, self._palms]) - origin[:, None],
            torque=_numpy(self._sim.data.actuator_force[:, self._actuators]),
            head_top=_numpy(data.geom_pos_w[:, self._head, 2]) + self._radius,
            broken=broken,
        )

    def friction(self) -> Array:
        """(N,) of the feet."""
        values = _numpy(self._sim.model.geom_friction[:, self._sole, 0])
        return np.broadcast_to(values, (self._env.num_envs,))


def _numpy(x: torch.Tensor) -> Array:
    return x.detach().cpu().numpy().astype(np.float64)


@dataclass(kw_only=True)
class TargetsCfg(ActionTermCfg):
    """The residual of the policy, turned into joint targets by `Walk`."""

    entity_name: str = ROBOT
    disturbances: DisturbanceConfig = field(default_factory=DisturbanceConfig)

    def build(self, env: ManagerBasedRlEnv) -> TargetsAction:
        return TargetsAction(self, env)


class TargetsAction(ActionTerm):
    """Joint targets that act after the delay of each robot, in physics steps."""

    cfg: TargetsCfg

    def __init__(self, cfg: TargetsCfg, env: ManagerBasedRlEnv) -> None:
        if cfg.disturbances.delay[1] > 1 / CONTROLLER_HZ:
            raise UsageError(
                f"delay: expected at most one tick of {1 / CONTROLLER_HZ} s in mjlab, "
                f"found {cfg.disturbances.delay[1]}"
            )
        super().__init__(cfg, env)
        self._term = logic_term(env)
        shape = (self.num_envs, len(JOINT_NAMES))
        self._raw = torch.zeros((self.num_envs, ACTIONS), device=self.device)
        self._old = torch.zeros(shape, device=self.device)
        self._new = torch.zeros(shape, device=self.device)
        self._delay = torch.zeros((self.num_envs, 1), dtype=torch.long, device=self.device)
        self._step = 0

    @property
    def action_dim(self) -> int:
        return ACTIONS

    @property
    def raw_action(self) -> torch.Tensor:
        return self._raw

    def process_actions(self, actions: torch.Tensor) -> None:
        self._raw[:] = actions
        self._old[:] = self._new
        self._new[:] = self._term.targets(actions)
        self._step = 0

    def apply_actions(self) -> None:
        target = torch.where(self._step < self._delay, self._old, self._new)
        self._entity.set_joint_position_target(target, joint_ids=self._term.robot.joints)
        self._step += 1

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        ids = slice(None) if env_ids is None else env_ids
        n = len(self._delay[ids])
        drawn = physics.random_delays(n, self.cfg.disturbances, self._term.logic.rng)
        self._delay[ids] = torch.from_numpy(drawn)[:, None].to(self._delay)
        self._raw[ids] = 0.0
        now = self._entity.data.joint_pos[:, self._term.robot.joints]
        self._new[ids] = now[ids]


def logic_term(env: ManagerBasedRlEnv) -> TaskLogicTerm:
    """The term that holds the task logic."""
    term = env.command_manager.get_term(LOGIC)
    assert isinstance(term, TaskLogicTerm)
    return term


def observation(env: ManagerBasedRlEnv, group: str) -> torch.Tensor:
    """See `TaskLogicTerm.observation`."""
    return logic_term(env).observation(group)


def fallen(env: ManagerBasedRlEnv) -> torch.Tensor:
    """(N,); also computes the rewards, because mjlab evaluates terminations before rewards."""
    return logic_term(env).evaluate_tick()


def reward(env: ManagerBasedRlEnv, term: str) -> torch.Tensor:
    """(N,) a term of `rewards`, per second."""
    return logic_term(env).reward(term)


def difficulty(env: ManagerBasedRlEnv, env_ids: torch.Tensor) -> float:
    """For the log."""
    return logic_term(env).logic.difficulty


def stand(env: ManagerBasedRlEnv, env_ids: torch.Tensor) -> None:
    """Initial state of new episodes."""
    term, robot = logic_term(env), env.scene[ROBOT]
    qpos = (
        torch.from_numpy(physics.random_qpos(len(env_ids), term.logic.rng)).float().to(env.device)
    )
    state = torch.zeros((len(env_ids), 13), device=env.device)
    state[:, :7] = qpos[:, :7]
    state[:, :3] += env.scene.env_origins[env_ids]
    robot.write_root_state_to_sim(state, env_ids=env_ids)
    joints = torch.zeros((len(env_ids), len(JOINT_NAMES)), device=env.device)
    joints[:, term.robot.joints] = qpos[:, 7:]
    robot.write_joint_state_to_sim(joints, torch.zeros_like(joints), env_ids=env_ids)


def push(env: ManagerBasedRlEnv, env_ids: torch.Tensor) -> None:
    """A horizontal impulse, limited by the difficulty."""
    term, robot = logic_term(env), env.scene[ROBOT]
    kick = random_push(
        len(env_ids), term.cfg.task.disturbances, term.logic.difficulty, term.logic.rng
    )
    term.logic.pushed(env_ids.cpu().numpy())
    velocity = robot.data.root_link_vel_w[env_ids].clone()
    velocity[:, :2] += torch.from_numpy(kick).to(velocity)
    robot.write_root_link_velocity_to_sim(velocity, env_ids=env_ids)
