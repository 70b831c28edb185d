"""``--env.type=egovcp``: options of the simulation, and the creation of environments."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.processor import InfoProcessorStep, PolicyProcessorPipeline

from egovcp import spec
from egovcp.bounds import check_cores
from egovcp.errors import UsageError
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import EnvConfig as SimulationConfig
from egovcp.sim.tasks.registry import DEFAULT_TASK, find_task
from lerobot_env_egovcp.environment_egovcp import LeRobotEgovcpEnv


def _features() -> dict[str, PolicyFeature]:
    return {
        "images.ego_depth": PolicyFeature(
            FeatureType.VISUAL, (1, spec.DEPTH_ROWS, spec.DEPTH_COLS)
        ),
        "agent_pos": PolicyFeature(FeatureType.STATE, (spec.STATE_DIM,)),
        "action": PolicyFeature(FeatureType.ACTION, (spec.ACTION_DIM,)),
    }


#: The environment's names -> LeRobot's.
_NAMES = {
    "images.ego_depth": spec.DEPTH_KEY,
    "agent_pos": spec.STATE_KEY,
    "action": spec.ACTION_KEY,
}


@dataclass
class ControllerIdProcessorStep(InfoProcessorStep):  # type: ignore[misc]
    """Adds the id of the low-level controller to ``info``, for policies to check.

    LeRobot passes a policy neither the environment nor its config.
    """

    controller_id: str
    """`LowLevelController.id` of the simulated robots."""

    def info(self, info: dict[str, Any]) -> dict[str, Any]:
        return {**info, spec.CONTROLLER_ID_KEY: self.controller_id}

    def get_config(self) -> dict[str, Any]:
        return {"controller_id": self.controller_id}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


@EnvConfig.register_subclass("egovcp")
@dataclass
class EgovcpEnvConfig(EnvConfig):  # type: ignore[misc]
    """A task with its scene, sensors and randomisation."""

    task: str | None = DEFAULT_TASK
    """One of `egovcp-task list` with the G1, such as ball."""
    fps: int = spec.PLANNER_HZ
    """Planner ticks per second; fixed."""
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    """Scene, sensors, randomisation and low-level controller."""
    features: dict[str, PolicyFeature] = field(default_factory=_features)
    """Observations and actions."""
    features_map: dict[str, str] = field(default_factory=_NAMES.copy)
    """LeRobot's names of the features."""

    def __post_init__(self) -> None:
        robot = find_task(str(self.task), "--env.task").robot_spec()
        if not robot.is_g1:
            raise UsageError(
                f"--env.task={self.task} is of robot {robot.robot_type}: the features of "
                "--env.type=egovcp are the G1's; use egovcp-eval"
            )
        if self.fps != spec.PLANNER_HZ:
            raise UsageError(f"--env.fps={self.fps}; the planner runs at {spec.PLANNER_HZ} Hz")

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"task": self.task, "config": self.simulation}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv[Any, Any, Any]]]:
        """``n_envs`` robots, in one process or in one process each."""
        check_cores(self.simulation, "--env.simulation.")
        make = [partial(LeRobotEgovcpEnv, **self.gym_kwargs)] * n_envs
        mode = gymnasium.vector.AutoresetMode.SAME_STEP
        envs: gymnasium.vector.VectorEnv[Any, Any, Any] = (
            gymnasium.vector.AsyncVectorEnv(make, context="forkserver", autoreset_mode=mode)
            if use_async_envs and n_envs > 1
            else gymnasium.vector.SyncVectorEnv(make, autoreset_mode=mode)
        )
        return {self.type: {0: envs}}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Pre- and postprocessors of these environments."""
        step = ControllerIdProcessorStep(make_controller(self.simulation.controller).id)
        return PolicyProcessorPipeline(steps=[step]), PolicyProcessorPipeline(steps=[])
