"""The vectorised environment: many robots, one controller call for all of them.

Within a planner tick the action is limited and sent. Then, twice, the command that is due after
the action delay goes to the controller (50 Hz, whole batch), and every robot does four physics
steps of 5 ms under the joint targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.controllers import LowLevelController, absolute_controller, make_controller
from egovcp.robot_spec import G1
from egovcp.sim.base_env import (
    BaseVectorEnv,
    Observation,
    StepResult,
    one_robot,
    reporting_plugin_errors,
)
from egovcp.sim.camera import RayCastCamera
from egovcp.sim.instance import EnvInstance, settle
from egovcp.sim.scenario import Scenario
from egovcp.spec import (
    ACTION_BOX,
    COMMAND_SLICE,
    CONTROLLER_TICKS_PER_PLAN,
    DEPTH_COLS,
    DEPTH_MAX_M,
    DEPTH_ROWS,
    STATE_DIM,
)

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PrivilegedState:
    """Simulator state of all rows, for studies, never for a policy.

    ``_w``: world, ``_b``: pelvis heading frame.
    """

    since_event: Array
    """(B,) s since the event of the task; negative before, -inf if there is none."""
    pelvis_w: Array  # (B, 7) position m, quaternion wxyz
    pelvis_velocity_w: Array  # (B, 3) m/s
    hands_b: Array  # (B, 2, 3) palm sites, m
    object_b: Array  # (B, 3) position of the task's object, m; NaN: there is none


def resolve_config(config: EnvConfig, tasks: Sequence[str]) -> EnvConfig:
    """``config`` with the path of its controller's file made absolute.

    Raises:
        UsageError: the controller does not suit one of ``tasks``.
    """
    if tasks and not one_robot(tasks).is_g1:
        return config
    walks = make_controller(config.controller).walks
    for task in tasks:
        config.require_walking(task, walks)
    return replace(config, controller=absolute_controller(config.controller))


class VectorEnv(BaseVectorEnv):
    """B robots of type G1, each in its own episode.

    Args:
        render_depth: if false, depth images are zero, which is faster; all else is the same.

    Raises:
        UsageError: unknown task, wrong shapes, actions that are not numbers, or a task in which
            the robot walks, with a controller that does not.
    """

    def __init__(
        self,
        config: EnvConfig,
        num_envs: int,
        controller: LowLevelController | None = None,
        render_depth: bool = True,
    ) -> None:
        slowest = -(-config.delay.action_ticks[1] // CONTROLLER_TICKS_PER_PLAN)
        super().__init__(config, num_envs, G1, 1 + slowest)
        self.instances: list[EnvInstance] = []
        self.controller = controller or make_controller(config.controller)
        self._camera = RayCastCamera(config.camera)
        self._render_depth = render_depth
        self._standing = settle(config, self.controller)
        self._pool = ThreadPoolExecutor(config.threads) if config.threads > 1 else None
        self._controller_state = np.zeros((num_envs, STATE_DIM))

    @property
    def controller_id(self) -> str:
        """Identity of the robot's low-level controller."""
        return self.controller.id

    def _check(self, scenarios: Sequence[Scenario]) -> None:
        super()._check(scenarios)
        for scenario in scenarios:
            self.config.require_walking(scenario.task, self.controller.walks)

    def _instance(self, scenario: Scenario) -> EnvInstance:
        return EnvInstance(self.config, self._camera, self._standing, scenario, self._render_depth)

    def _begin(self, rows: NDArray[np.intp] | None) -> Observation:
        observation = super()._begin(rows)
        self._measure(self._sent[:, 0])
        self.controller.reset(self._controller_state, rows)
        return observation

    @reporting_plugin_errors()
    def step(self, action: NDArray[np.floating]) -> StepResult:
        """Send one normalised action (B, 7) per row and let a planner tick (40 ms) pass."""
        live = ~self.done
        self._send(action, live)
        for k in range(CONTROLLER_TICKS_PER_PLAN):
            self._measure(self._due_action(k))
            self._advance(self.controller.step(self._controller_state))
        terms = [
            instance.end_tick(self._sent[row, 0]) for row, instance in enumerate(self.instances)
        ]
        return self._result(terms)

    def _due_action(self, k: int) -> Array:
        """(B, 7) the action in effect in controller tick ``k`` of this planner tick."""
        delay = np.array([instance.action_delay for instance in self.instances])
        age = np.maximum(0, -((k - delay) // CONTROLLER_TICKS_PER_PLAN))
        due: Array = self._sent[np.arange(self.num_envs), age]
        return due

    def _measure(self, action: Array) -> None:
        """The controllers' observations: fresh measurements and the command in effect."""
        for row, instance in enumerate(self.instances):
            self._controller_state[row] = instance.state
        self._controller_state[:, COMMAND_SLICE] = self._command(action)

    def _command(self, action: Array) -> Array:
        """(B, 7) normalised actions -> (B, 10) commands [v, hands, height]."""
        velocity = np.array([instance.task.velocity_command for instance in self.instances])
        return np.concatenate([velocity, ACTION_BOX.to_metric(action)], axis=1)

    def _observe(self) -> Observation:
        state = np.array([instance.state for instance in self.instances])
        state[:, COMMAND_SLICE] = self._command(self._sent[:, 0])
        depth = np.empty((self.num_envs, DEPTH_ROWS, DEPTH_COLS), dtype=np.uint16)
        for row, instance in enumerate(self.instances):
            depth[row] = instance.depth
        return Observation(depth, state.astype(np.float32))

    def _advance(self, targets: Array) -> None:
        """One controller tick of every row; physics and rays release the interpreter lock."""

        def work(rows: NDArray[np.intp]) -> None:
            for row in rows:
                self.instances[row].advance(targets[row])

        chunks = np.array_split(np.arange(self.num_envs), self.config.threads)
        if self._pool is None:
            work(chunks[0])
            return
        for pending in [self._pool.submit(work, rows) for rows in chunks]:
            pending.result()

    def _in_range(self, position: Array) -> bool:
        return bool(0.0 < position[0] < DEPTH_MAX_M)  # in front of the pelvis; false for NaN

    def privileged_state(self) -> PrivilegedState:
        """The simulator's state now."""
        robots = [instance.robot for instance in self.instances]
        tasks = [instance.task for instance in self.instances]
        return PrivilegedState(
            since_event=np.array([task.since_event for task in tasks]),
            pelvis_w=np.array([robot.data.qpos[:7] for robot in robots]),
            pelvis_velocity_w=np.array([robot.data.qvel[:3] for robot in robots]),
            hands_b=np.array([robot.palms_b for robot in robots]),
            object_b=np.array([task.object_b for task in tasks]),
        )

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
