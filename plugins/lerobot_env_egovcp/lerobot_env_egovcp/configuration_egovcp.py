"""``--env.type=egovcp``: the simulation's options, and how LeRobot makes environments of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.processor import PolicyProcessorPipeline

from egovcp import spec
from egovcp.bounds import check_cores
from egovcp.errors import UsageError, suggest
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import EnvConfig as SimulationConfig
from lerobot_env_egovcp.environment_egovcp import LeRobotView
from lerobot_env_egovcp.processor_egovcp import ControllerIdProcessorStep


def _features() -> dict[str, PolicyFeature]:
    return {
        "images.ego_depth": PolicyFeature(
            FeatureType.VISUAL, (1, spec.DEPTH_ROWS, spec.DEPTH_COLS)
        ),
        "agent_pos": PolicyFeature(FeatureType.STATE, (spec.STATE_DIM,)),
        "action": PolicyFeature(FeatureType.ACTION, (spec.ACTION_DIM,)),
    }


def _names() -> dict[str, str]:
    """The environment's names -> LeRobot's."""
    return {
        "images.ego_depth": spec.DEPTH_KEY,
        "agent_pos": spec.STATE_KEY,
        "action": spec.ACTION_KEY,
    }


@EnvConfig.register_subclass("egovcp")
@dataclass
class EgovcpEnvConfig(EnvConfig):  # type: ignore[misc]
    """One of the three tasks with its scene, sensors and randomisation."""

    task: str | None = "ball"
    """ball, wall or arch."""
    fps: int = spec.PLANNER_HZ
    """Planner ticks per second; fixed."""
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    """Scene, sensors, randomisation and low-level controller."""
    features: dict[str, PolicyFeature] = field(default_factory=_features)
    """What the environment shows and takes."""
    features_map: dict[str, str] = field(default_factory=_names)
    """LeRobot's names for it."""

    def __post_init__(self) -> None:
        if self.task not in spec.TASKS:
            raise UsageError(f"no task {self.task!r}{suggest(str(self.task), spec.TASKS)}")
        if self.fps != spec.PLANNER_HZ:
            raise UsageError(f"--env.fps={self.fps}; the planner runs at {spec.PLANNER_HZ} Hz")

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `LeRobotView`."""
        return {"task": self.task, "config": self.simulation}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv[Any, Any, Any]]]:
        """``n_envs`` robots side by side, in one process or in one each."""
        check_cores(self.simulation, "--env.simulation.")
        make = [partial(LeRobotView, **self.gym_kwargs)] * n_envs
        mode = gymnasium.vector.AutoresetMode.SAME_STEP
        envs: gymnasium.vector.VectorEnv[Any, Any, Any] = (
            gymnasium.vector.AsyncVectorEnv(make, context="forkserver", autoreset_mode=mode)
            if use_async_envs and n_envs > 1
            else gymnasium.vector.SyncVectorEnv(make, autoreset_mode=mode)
        )
        return {self.type: {0: envs}}

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """What LeRobot applies to observations and to actions of these environments.

        Raises:
            UsageError, ArtifactError: as `make_controller`, for ``simulation.controller``.
        """
        step = ControllerIdProcessorStep(make_controller(self.simulation.controller).id)
        return PolicyProcessorPipeline(steps=[step]), PolicyProcessorPipeline(steps=[])
