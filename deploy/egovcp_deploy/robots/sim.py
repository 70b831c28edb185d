"""A simulated robot in lock-step: a `BaseVectorEnv` with one row."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import CameraView
from egovcp.sim.base_env import BaseVectorEnv, Observation, reporting_plugin_errors
from egovcp.sim.config import EnvConfig
from egovcp.sim.robot_env import make_env
from egovcp.sim.tasks.registry import find_task
from egovcp.spec import ACTION_TERMS, Solid
from egovcp_deploy.options import held_out
from egovcp_deploy.robots.base import ActionResult, RobotObservation

#: Reward term -> event that is logged when the term is first nonzero in an episode; other terms
#: are logged by name.
_TERM_EVENTS: Final = {
    "block": "blocked by a hand",
    "hit": "body hit",
    "pass": "passed",
    "fall": "robot fell",
}


class SimRobot:
    """Robot in lock-step whose rollout i is held-out scenario i of ``task`` and ``seed``."""

    def __init__(self, config: EnvConfig, task: str, seed: int) -> None:
        self.env = make_env(config, 1, [task])
        """The simulator, for scripted policies that use its privileged state."""
        self.controller_id = self.env.controller_id
        """Identity of the simulated robot's low-level controller."""
        self.spec = self.env.robot
        """The kind of robot."""
        self._camera, self._task, self._seed = config.camera, task, seed
        self._observation: Observation | None = None
        self._logged: set[str] = set()

    @property
    def camera(self) -> CameraView:
        """The camera of the G1 with this episode's randomised pitch; of another robot the default,
        which is not used."""
        if not self.spec.is_g1:
            return CameraView()
        pitch = self.env.instances[0].camera_pitch if self.env.instances else 0.0
        return CameraView("torso_link", self._camera.position, pitch, self._camera.vertical_fov)

    def start(self, episode: int) -> None:
        """Reset to scenario ``episode``."""
        self.scenario = held_out(self._task, self._seed, episode)
        self._observation = self.env.reset([self.scenario])
        self._logged = set()

    def observe(self) -> RobotObservation:
        """Return the observation, with the simulator's poses of pelvis and scene."""
        assert self._observation is not None, "start an episode first"
        poses = true_poses(self.env, 0)
        return RobotObservation(self._observation.depth[0], self._observation.state[0], *poses)

    def act(self, action: NDArray[np.float64]) -> ActionResult:
        """Apply ``action`` (A,) for one planner tick, 40 ms of the G1."""
        result = self.env.step(action[None])
        self._observation = result.observation
        terms = {name: float(values[0]) for name, values in result.reward_terms.items()}
        return ActionResult(
            sent=result.sent_action[0],
            reward=float(result.reward[0]),
            reward_terms=terms,
            terminated=bool(result.terminated[0]),
            truncated=bool(result.truncated[0]),
            success=bool(result.success[0]),
            parts=result.parts[0],
            events=tuple(self._events(terms)),
        )

    def _events(self, terms: dict[str, float]) -> list[str]:
        """Events that happened for the first time in this episode."""
        task = self.env.instances[0].task
        events = [find_task(task.current_name).event] if task.since_event > 0.0 else []
        counted = [n for n, value in terms.items() if value != 0.0 and n not in ACTION_TERMS]
        events += [_TERM_EVENTS.get(name, name) for name in counted]
        events = [text for text in events if text not in self._logged]
        self._logged.update(events)
        return events

    def damp(self) -> None:
        """Damp the simulated motors until the next `start`."""
        self.env.damp(0)

    def close(self) -> None:
        """Stop the simulator's threads."""
        self.env.close()


@reporting_plugin_errors()
def true_poses(env: BaseVectorEnv, row: int) -> tuple[NDArray[np.float64], tuple[Solid, ...]]:
    """Pose (7,) of the base and the scene of one robot, see `Tick`."""
    return env.instances[row].base_pose.copy(), env.instances[row].task.solids()
