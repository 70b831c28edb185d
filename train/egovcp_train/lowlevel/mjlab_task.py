"""The low-level task for mjlab: physics on the GPU, everything else as on the CPU.

mjlab finds ``Egovcp-LowLevel-Unitree-G1`` by this package's entry point (group ``mjlab.tasks``):

    train Egovcp-LowLevel-Unitree-G1 --env.scene.num-envs 4096

Commands, surroundings of the policy (`Walk`), rewards, disturbances, gains and curriculum are the
very objects of `env`; they run in numpy on the host, once per tick, on 0.3 kB per robot. What
differs: physical parameters are drawn by mjlab, masses body by body. Every checkpoint is written
as ``model_N.safetensors``, too, which the simulator, the evaluation and the robot load.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import torch
from mjlab.actuator import XmlActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs import mdp as envs_mdp
from mjlab.envs.mdp import dr
from mjlab.managers.action_manager import ActionTerm, ActionTermCfg
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
from mjlab.rl.runner import MjlabOnPolicyRunner
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.registry import register_mjlab_task
from mjlab.terrains import TerrainEntityCfg
from numpy.typing import NDArray

from egovcp.robot.mjcf import robot_spec
from egovcp.robot.stance_table import NU, standing_pose
from egovcp.robot.walking import ACTIONS, Walk, WalkConfig
from egovcp.sim.config import SensorConfig
from egovcp.sim.scene import strip_visuals
from egovcp.sim.sensors import noise_std
from egovcp.spec import (
    ACTION_BOX,
    COMMAND_DIM,
    CONTROLLER_HZ,
    JOINT_NAMES,
    PHYSICS_DT,
    PHYSICS_STEPS_PER_CONTROLLER_TICK,
)
from egovcp_train.lowlevel import events, rewards, sensing
from egovcp_train.lowlevel.commands import Commands
from egovcp_train.lowlevel.config import CurriculumConfig, NetworkConfig, PpoConfig
from egovcp_train.lowlevel.learn import adapted, rsl_rl_config, start_at_zero, walk_policy
from egovcp_train.lowlevel.physics import HEAD, Snapshot
from egovcp_train.lowlevel.task import DisturbanceConfig, LowLevelTask

TASK_ID = "Egovcp-LowLevel-Unitree-G1"
_ROBOT, _LOOP = "robot", "loop"
_FEET = ("left_ankle_roll_link", "right_ankle_roll_link")
_PALMS = ("left_palm", "right_palm")
_NEVER = 1e9  # s; `Commands` draws anew by itself

Array = NDArray[np.float64]


# --- the loop on the host --------------------------------------------------------------


@dataclass(kw_only=True)
class LoopCfg(CommandTermCfg):
    """The command term that holds all state which the CPU environment has."""

    resampling_time_range: tuple[float, float] = (_NEVER, _NEVER)
    task: LowLevelTask = field(default_factory=LowLevelTask)
    walk: WalkConfig = field(default_factory=WalkConfig)
    sensors: SensorConfig = field(default_factory=SensorConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    ticks_per_iteration: int = PpoConfig.num_steps_per_env

    def build(self, env: ManagerBasedRlEnv) -> Loop:
        return Loop(self, env)


class Loop(CommandTerm):
    """Commands, `Walk` and rewards of all robots; the other terms read from it."""

    cfg: LoopCfg

    def __init__(self, cfg: LoopCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        n = self.num_envs
        self.rng = np.random.default_rng(env.cfg.seed)
        self.commands = Commands(n, cfg.task.commands, self.rng)
        self.walk = Walk(cfg.walk)
        self.robot = _Robot(env)
        self.action = np.zeros((n, ACTIONS))
        self.last_action = np.zeros((n, ACTIONS))
        self._motion = rewards.Motion(n)
        self._noise = noise_std(cfg.sensors)
        self._fresh = np.ones(n, dtype=bool)
        self._fallen: NDArray[np.bool_] = np.zeros(n, dtype=np.bool_)
        self._falls = self._tracked = 0.0
        self._ticks = 0
        self._observations: tuple[torch.Tensor, torch.Tensor] | None = None
        self._rewards: dict[str, torch.Tensor] = {}

    # --- for the other terms ---------------------------------------------------------
    @property
    def command(self) -> torch.Tensor:
        """(N, 10) v, hands, height."""
        return self._tensor(self.commands.vector)

    @property
    def difficulty(self) -> float:
        return self.commands.difficulty

    @difficulty.setter
    def difficulty(self, value: float) -> None:
        self.commands.difficulty = float(np.clip(value, 0.0, 1.0))

    def observation(self, which: int) -> torch.Tensor:
        """0: what the policy sees (N, 95); 1: what only the critic sees (N, 16)."""
        if self._observations is None:
            self._observe()
        assert self._observations is not None
        return self._observations[which]

    def targets(self, action: torch.Tensor) -> torch.Tensor:
        """(N, 15) -> joint targets (N, 29), rad."""
        self.last_action = self.action
        self.action = action.detach().cpu().numpy().astype(np.float64)
        return self._tensor(self.walk.targets(self.action))

    def judge(self) -> torch.Tensor:
        """(N,) which robots have fallen; called once per tick, before `reward`."""
        x = self.robot.snapshot()
        self._motion.add(x)
        walk, gait = self.walk, self.walk.gait
        terms = rewards.terms(
            x,
            self._motion.average,
            self.commands.vector,
            walk.height,
            walk.pitch,
            gait.phase,
            gait.amount,
            self.action,
            self.last_action,
        )
        self._fallen = rewards.fallen(x, walk.height, walk.pitch)
        ok = ~x.broken
        values = {name: np.where(ok, np.nan_to_num(v), 0.0) for name, v in terms.items()}
        self._rewards = {name: self._tensor(v) for name, v in values.items()}
        self._rewards["fall"] = self._tensor(self._fallen)
        self._adapt(values["velocity"])
        return torch.from_numpy(self._fallen).to(self.device)

    def reward(self, name: str) -> torch.Tensor:
        """(N,) one term of the last tick."""
        return self._rewards[name]

    # --- mjlab's hooks ---------------------------------------------------------------
    def _update_metrics(self) -> None:
        """Rewards are logged by mjlab; there is nothing else."""

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        rows = env_ids.cpu().numpy()
        self.commands.reset(rows)
        self._motion.reset(rows)
        self.action[rows] = 0.0
        self._fresh[rows] = True

    def _update_command(self, env_ids: torch.Tensor | None) -> None:
        """Once per tick (or reset), with the simulation up to date."""
        if env_ids is None:
            self.commands.advance()
        self._observations = None

    # --- inside ----------------------------------------------------------------------
    def _observe(self) -> None:
        x = self.robot.snapshot()
        state = sensing.measure(x, self.commands.vector, self._noise, self.rng)
        rows = np.flatnonzero(self._fresh)
        if len(rows):
            self.walk.reset(state, None if len(rows) == self.num_envs else rows)
            self._fresh[:] = False
        policy = self.walk.observe(state)
        privileged = sensing.privileged(
            x, self._motion.average, self.walk.height, self.robot.friction()
        )
        self._observations = self._tensor(policy), self._tensor(privileged)

    def _adapt(self, velocity: Array) -> None:
        """The curriculum's rule, as often as an iteration of PPO."""
        self._falls += float(self._fallen.mean()) * CONTROLLER_HZ
        self._tracked += float(velocity.mean())
        self._ticks += 1
        if self._ticks == self.cfg.ticks_per_iteration:
            falls, tracked = self._falls / self._ticks, self._tracked / self._ticks
            self.difficulty = adapted(self.difficulty, falls, tracked, self.cfg.curriculum)
            self._falls = self._tracked = 0.0
            self._ticks = 0

    def _tensor(self, value: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.asarray(value, dtype=np.float32)).to(self.device)


class _Robot:
    """The robots of an mjlab scene as the CPU environment knows them."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env, self._sim = env, cast("Any", env.sim)
        self._entity = robot = env.scene[_ROBOT]
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
            feet_forward=_forward(_numpy(data.body_link_quat_w[:, self._feet])),
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


def _forward(quaternion: Array) -> Array:
    """(..., 4) wxyz -> (..., 3) x axes."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    axes = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    return np.stack(axes, axis=-1)


# --- terms -----------------------------------------------------------------------------


@dataclass(kw_only=True)
class TargetsCfg(ActionTermCfg):
    """The residual of the policy, turned into joint targets by `Walk`."""

    entity_name: str = _ROBOT
    disturbances: DisturbanceConfig = field(default_factory=DisturbanceConfig)

    def build(self, env: ManagerBasedRlEnv) -> Targets:
        return Targets(self, env)


class Targets(ActionTerm):
    """New targets act some physics steps late, as many as the robot's delay."""

    cfg: TargetsCfg

    def __init__(self, cfg: TargetsCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self._loop = loop(env)
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
        self._new[:] = self._loop.targets(actions)
        self._step = 0

    def apply_actions(self) -> None:
        target = torch.where(self._step < self._delay, self._old, self._new)
        self._entity.set_joint_position_target(target, joint_ids=self._loop.robot.joints)
        self._step += 1

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        ids = slice(None) if env_ids is None else env_ids
        n = len(self._delay[ids])
        drawn = events.delays(n, self.cfg.disturbances, self._loop.rng)
        self._delay[ids] = torch.from_numpy(drawn)[:, None].to(self._delay)
        self._raw[ids] = 0.0
        now = self._entity.data.joint_pos[:, self._loop.robot.joints]
        self._new[ids] = now[ids]


def loop(env: ManagerBasedRlEnv) -> Loop:
    """The term that holds the state of the task."""
    term = env.command_manager.get_term(_LOOP)
    assert isinstance(term, Loop)
    return term


def policy_observation(env: ManagerBasedRlEnv) -> torch.Tensor:
    """(N, 95)."""
    return loop(env).observation(0)


def privileged_observation(env: ManagerBasedRlEnv) -> torch.Tensor:
    """(N, 16)."""
    return loop(env).observation(1)


def fallen(env: ManagerBasedRlEnv) -> torch.Tensor:
    """(N,)."""
    return loop(env).judge()


def reward(env: ManagerBasedRlEnv, term: str) -> torch.Tensor:
    """(N,) a term of `rewards`, per second."""
    return loop(env).reward(term)


def difficulty(env: ManagerBasedRlEnv, env_ids: torch.Tensor) -> float:
    """For the log."""
    return loop(env).difficulty


def stand(env: ManagerBasedRlEnv, env_ids: torch.Tensor) -> None:
    """New episodes start as on the CPU."""
    term, robot = loop(env), env.scene[_ROBOT]
    qpos = torch.from_numpy(events.standing(len(env_ids), term.rng)).float().to(env.device)
    state = torch.zeros((len(env_ids), 13), device=env.device)
    state[:, :7] = qpos[:, :7]
    state[:, :3] += env.scene.env_origins[env_ids]
    robot.write_root_state_to_sim(state, env_ids=env_ids)
    joints = torch.zeros((len(env_ids), len(JOINT_NAMES)), device=env.device)
    joints[:, term.robot.joints] = qpos[:, 7:]
    robot.write_joint_state_to_sim(joints, torch.zeros_like(joints), env_ids=env_ids)


def push(env: ManagerBasedRlEnv, env_ids: torch.Tensor) -> None:
    """A horizontal impulse, of at most the speed that the difficulty allows."""
    term, robot = loop(env), env.scene[_ROBOT]
    kick = events.pushes(len(env_ids), term.cfg.task.disturbances, term.difficulty, term.rng)
    velocity = robot.data.root_link_vel_w[env_ids].clone()
    velocity[:, :2] += torch.from_numpy(kick).to(velocity)
    robot.write_root_link_velocity_to_sim(velocity, env_ids=env_ids)


# --- configuration ---------------------------------------------------------------------


def _spec() -> Any:
    """The robot of the CPU environment: its gains and four points per foot."""
    spec = robot_spec("points")
    strip_visuals(spec)
    for key in list(spec.keys):
        spec.delete(key)
    spec.option = mujoco.MjSpec().option  # `SimulationCfg` sets them, for the whole scene
    return spec


def _robot_cfg() -> EntityCfg:
    pose = standing_pose(ACTION_BOX.neutral[-1])
    return EntityCfg(
        init_state=EntityCfg.InitialStateCfg(
            pos=tuple(pose.position.tolist()),
            rot=tuple(pose.quaternion.tolist()),
            joint_pos=dict(zip(JOINT_NAMES, pose.joints.tolist(), strict=True)),
        ),
        spec_fn=_spec,
        articulation=EntityArticulationInfoCfg(
            actuators=(XmlActuatorCfg(target_names_expr=JOINT_NAMES),)
        ),
    )


def env_cfg(
    num_envs: int = 4096, task: LowLevelTask | None = None, walk: WalkConfig | None = None
) -> ManagerBasedRlEnvCfg:
    """The environment, with the numbers of ``task`` and ``walk``."""
    task = task or LowLevelTask()
    term = LoopCfg(task=task, walk=walk or WalkConfig())
    return ManagerBasedRlEnvCfg(
        decimation=PHYSICS_STEPS_PER_CONTROLLER_TICK,
        scene=SceneCfg(
            num_envs=num_envs,
            terrain=TerrainEntityCfg(terrain_type="plane"),
            entities={_ROBOT: _robot_cfg()},
        ),
        sim=SimulationCfg(nconmax=24, njmax=120, mujoco=MujocoCfg(timestep=PHYSICS_DT)),
        commands={_LOOP: term},
        actions={"targets": TargetsCfg(disturbances=task.disturbances)},
        observations={
            "policy": ObservationGroupCfg({"walk": ObservationTermCfg(func=policy_observation)}),
            "privileged": ObservationGroupCfg(
                {"truth": ObservationTermCfg(func=privileged_observation)}
            ),
        },
        events=_events(task.disturbances),
        rewards={
            name: RewardTermCfg(func=reward, weight=weight, params={"term": name})
            for name, weight in asdict(task.rewards).items()
        },
        terminations={
            "fallen": TerminationTermCfg(func=fallen),
            "time_out": TerminationTermCfg(func=envs_mdp.time_out, time_out=True),
        },
        curriculum={"difficulty": CurriculumTermCfg(func=difficulty)},
        episode_length_s=task.episode,
    )


def _events(config: DisturbanceConfig) -> dict[str, EventTermCfg]:
    soles = SceneEntityCfg(_ROBOT, geom_names=(".*_foot.*",))
    torso = SceneEntityCfg(_ROBOT, body_names=("torso_link",))
    density = tuple(0.5 * math.log(scale) for scale in config.mass_scale)

    def once(func: Any, **params: Any) -> EventTermCfg:
        return EventTermCfg(func=func, mode="startup", params=params)

    return {
        "stand": EventTermCfg(func=stand, mode="reset"),
        "push": EventTermCfg(func=push, mode="interval", interval_range_s=config.push_interval),
        "friction": once(
            dr.geom_friction, ranges=config.friction, asset_cfg=soles, shared_random=True
        ),
        "masses": once(
            dr.pseudo_inertia,
            alpha_range=density,
            asset_cfg=SceneEntityCfg(_ROBOT, body_names=(".*",)),
        ),
        "payload": once(dr.body_mass, ranges=config.payload, operation="add", asset_cfg=torso),
        "gains": once(
            dr.pd_gains,
            kp_range=config.stiffness_scale,
            kd_range=config.damping_scale,
            asset_cfg=SceneEntityCfg(_ROBOT),
        ),
    }


@dataclass
class SymmetricPpoCfg(RslRlPpoAlgorithmCfg):
    """PPO that also learns from each sample's mirror image."""

    symmetry_cfg: dict[str, Any] = field(default_factory=dict)
    rnd_cfg: dict[str, Any] | None = None


def rl_cfg(network: NetworkConfig | None = None, ppo: PpoConfig | None = None) -> Any:
    """PPO as on the CPU."""
    shared = rsl_rl_config(network or NetworkConfig(), ppo or PpoConfig())
    algorithm = shared["algorithm"]
    algorithm["symmetry_cfg"]["data_augmentation_func"] = "egovcp_train.lowlevel.env:mirrored"
    return RslRlOnPolicyRunnerCfg(
        actor=_model_cfg(shared["actor"]),
        critic=_model_cfg(shared["critic"]),
        algorithm=SymmetricPpoCfg(**algorithm),
        obs_groups={name: tuple(groups) for name, groups in shared["obs_groups"].items()},
        num_steps_per_env=shared["num_steps_per_env"],
        experiment_name="egovcp_lowlevel",
        logger="tensorboard",
        upload_model=False,
        max_iterations=2_000,
    )


def _model_cfg(options: dict[str, Any]) -> RslRlModelCfg:
    return RslRlModelCfg(**options | {"hidden_dims": tuple(options["hidden_dims"])})


class LowLevelRunner(MjlabOnPolicyRunner):
    """mjlab's runner, whose checkpoints hold the difficulty and come with the controller's file."""

    def __init__(self, env: Any, train_cfg: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        super().__init__(env, train_cfg, *args, **kwargs)
        start_at_zero(self.alg.get_policy().mlp)

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """``model_N.pt`` to go on from, and ``model_N.safetensors`` to run."""
        term = loop(self.env.unwrapped)
        super().save(path, {**(infos or {}), "difficulty": term.difficulty})
        steps = self.current_learning_iteration * self.cfg["num_steps_per_env"] * self.env.num_envs
        provenance = {
            "task": TASK_ID,
            "steps": steps,
            "difficulty": term.difficulty,
            "seed": self.cfg["seed"],
        }
        policy = walk_policy(self.alg.get_policy(), term.cfg.walk, provenance)
        policy.save(Path(path).with_suffix(".safetensors"))

    def load(self, path: str, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Go on where ``path`` was saved."""
        infos: dict[str, Any] = super().load(path, *args, **kwargs)
        loop(self.env.unwrapped).difficulty = float((infos or {}).get("difficulty", 0.0))
        return infos


register_mjlab_task(
    task_id=TASK_ID,
    env_cfg=env_cfg(),
    play_env_cfg=env_cfg(num_envs=1),
    rl_cfg=rl_cfg(),
    runner_cls=LowLevelRunner,
)

assert COMMAND_DIM == 10
assert NU == ACTIONS
