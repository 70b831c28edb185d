"""The low-level task for mjlab: physics on the GPU, the rest as in the CPU environment.

mjlab finds ``Egovcp-LowLevel-Unitree-G1`` by this package's entry point (group ``mjlab.tasks``):

    train Egovcp-LowLevel-Unitree-G1 --env.scene.num-envs 4096

Commands, controller (`Walk`), rewards, pushes, gains and curriculum are those of the CPU
environment (`env.TaskLogic`). mjlab draws the physical parameters, masses body by body. Every
checkpoint comes with ``model_N.safetensors``, the controller's file.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import mujoco
from mjlab.actuator import XmlActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs import mdp as envs_mdp
from mjlab.envs.mdp import dr
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

from egovcp.robot.mjcf import robot_spec
from egovcp.robot.stance_table import standing_pose
from egovcp.robot.walking import WalkConfig
from egovcp.sim.scene import strip_visuals
from egovcp.spec import ACTION_BOX, JOINT_NAMES, PHYSICS_DT, PHYSICS_STEPS_PER_CONTROLLER_TICK
from egovcp_train.lowlevel import mjlab_terms as terms
from egovcp_train.lowlevel.config import DisturbanceConfig, LowLevelTask, NetworkConfig
from egovcp_train.lowlevel.learner import rsl_rl_config, walk_policy
from egovcp_train.lowlevel.mjlab_terms import (
    LOGIC,
    ROBOT,
    TargetsCfg,
    TaskLogicTermCfg,
    logic_term,
)
from egovcp_train.on_policy import RslRlPpoConfig, shrink_output

TASK_ID: Final = "Egovcp-LowLevel-Unitree-G1"


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
    term = TaskLogicTermCfg(task=task, walk=walk or WalkConfig())
    return ManagerBasedRlEnvCfg(
        decimation=PHYSICS_STEPS_PER_CONTROLLER_TICK,
        scene=SceneCfg(
            num_envs=num_envs,
            terrain=TerrainEntityCfg(terrain_type="plane"),
            entities={ROBOT: _robot_cfg()},
        ),
        sim=SimulationCfg(nconmax=24, njmax=120, mujoco=MujocoCfg(timestep=PHYSICS_DT)),
        commands={LOGIC: term},
        actions={"targets": TargetsCfg(disturbances=task.disturbances)},
        observations={
            group: ObservationGroupCfg(
                {"walk": ObservationTermCfg(func=terms.observation, params={"group": group})}
            )
            for group in ("policy", "privileged")
        },
        events=_events(task.disturbances),
        rewards={
            name: RewardTermCfg(func=terms.reward, weight=weight, params={"term": name})
            for name, weight in asdict(task.rewards).items()
        },
        terminations={
            "fallen": TerminationTermCfg(func=terms.fallen),
            "time_out": TerminationTermCfg(func=envs_mdp.time_out, time_out=True),
        },
        curriculum={"difficulty": CurriculumTermCfg(func=terms.difficulty)},
        episode_length_s=task.episode,
    )


def _events(config: DisturbanceConfig) -> dict[str, EventTermCfg]:
    soles = SceneEntityCfg(ROBOT, geom_names=(".*_foot.*",))
    torso = SceneEntityCfg(ROBOT, body_names=("torso_link",))
    density = tuple(0.5 * math.log(scale) for scale in config.mass_scale)

    def once(func: Any, **params: Any) -> EventTermCfg:
        return EventTermCfg(func=func, mode="startup", params=params)

    return {
        "stand": EventTermCfg(func=terms.stand, mode="reset"),
        "push": EventTermCfg(
            func=terms.push, mode="interval", interval_range_s=config.push_interval
        ),
        "friction": once(
            dr.geom_friction, ranges=config.friction, asset_cfg=soles, shared_random=True
        ),
        "masses": once(
            dr.pseudo_inertia,
            alpha_range=density,
            asset_cfg=SceneEntityCfg(ROBOT, body_names=(".*",)),
        ),
        "payload": once(dr.body_mass, ranges=config.payload, operation="add", asset_cfg=torso),
        "gains": once(
            dr.pd_gains,
            kp_range=config.stiffness_scale,
            kd_range=config.damping_scale,
            asset_cfg=SceneEntityCfg(ROBOT),
        ),
    }


@dataclass
class SymmetricPpoCfg(RslRlPpoAlgorithmCfg):
    """PPO that also learns from each sample's mirror image."""

    symmetry_cfg: dict[str, Any] = field(default_factory=dict)
    rnd_cfg: dict[str, Any] | None = None


def rl_cfg() -> Any:
    """PPO as on the CPU."""
    shared = rsl_rl_config(NetworkConfig(), RslRlPpoConfig())
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
    """mjlab's runner; its checkpoints hold the difficulty and come with the controller's file."""

    def __init__(self, env: Any, train_cfg: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        super().__init__(env, train_cfg, *args, **kwargs)
        shrink_output(self.alg.get_policy().mlp)

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Write ``model_N.pt`` to resume from, and the controller ``model_N.safetensors``."""
        term = logic_term(self.env.unwrapped)
        super().save(path, {**(infos or {}), "difficulty": term.logic.difficulty})
        steps = self.current_learning_iteration * self.cfg["num_steps_per_env"] * self.env.num_envs
        provenance = {
            "task": TASK_ID,
            "steps": steps,
            "difficulty": term.logic.difficulty,
            "seed": self.cfg["seed"],
        }
        policy = walk_policy(self.alg.get_policy(), term.cfg.walk, provenance)
        policy.save(Path(path).with_suffix(".safetensors"))

    def load(self, path: str, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Continue from ``path``."""
        infos: dict[str, Any] = super().load(path, *args, **kwargs)
        logic_term(self.env.unwrapped).logic.difficulty = float(
            (infos or {}).get("difficulty", 0.0)
        )
        return infos


register_mjlab_task(
    task_id=TASK_ID,
    env_cfg=env_cfg(),
    play_env_cfg=env_cfg(num_envs=1),
    rl_cfg=rl_cfg(),
    runner_cls=LowLevelRunner,
)
