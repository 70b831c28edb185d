"""What the environments of all robots share: results, rate limit, starts of episodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EgovcpError, UsageError
from egovcp.robot_spec import RobotSpec
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.registry import find_task, plugin_failure
from egovcp.spec import ACTION_RATE_LIMIT, OBJECT_DIM

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Observation:
    """Measurements of all robots at a planner tick; shapes are those of the robot."""

    depth: NDArray[np.uint16]  # (B, H, W) planar depth, mm, 0 invalid
    state: NDArray[np.float32]  # (B, S) proprioception in the layout of ``spec.STATE_SLICES``


@dataclass(frozen=True)
class StepResult:
    """Result of a planner tick; a row whose episode is over repeats its last observation."""

    observation: Observation
    reward: NDArray[np.float64]  # (B,) sum of the terms
    reward_terms: dict[str, NDArray[np.float64]]
    """(B,) per name; 0 where a row's task lacks the term."""
    terminated: NDArray[np.bool_]  # (B,) fallen
    truncated: NDArray[np.bool_]  # (B,) at the time limit
    success: NDArray[np.bool_]
    """(B,) whether the task would count as achieved if the episode ended now."""
    sent_action: Array  # (B, A) after the rate limit and the box
    parts: tuple[dict[str, bool], ...]
    """(B,) ``success`` of each part of a sequence; empty in a row of a single task."""


@contextmanager
def reporting_plugin_errors() -> Iterator[None]:
    """Turn an exception in the code of a plugin into an `EnvironmentFailure` that names it and says
    what to do; also a decorator."""
    try:
        yield
    except EgovcpError:
        raise
    except Exception as error:
        failure = plugin_failure(error)
        if failure is None:
            raise
        raise failure from error


def one_robot(tasks: Iterable[str]) -> RobotSpec:
    """The robot of ``tasks``, of which there is at least one.

    Raises:
        UsageError: the tasks are of different robots.
    """
    first, *others = dict.fromkeys(tasks)
    robot = find_task(first).robot_spec()
    require_robot(robot, others)
    require_class(getattr(find_task(first), "robot_class", None), others)
    return robot


def require_robot(robot: RobotSpec, tasks: Iterable[str]) -> None:
    """Raise `UsageError` unless all ``tasks`` are of ``robot``."""
    for task in tasks:
        found = find_task(task).robot_spec()
        if found is not robot and found != robot:
            raise UsageError(
                f"task {task} is of robot {found.robot_type}, expected one of robot "
                f"{robot.robot_type}: simulate, train and evaluate each robot by itself"
            )


def require_class(robot_class: type | None, tasks: Iterable[str]) -> None:
    """Raise `UsageError` unless all ``tasks`` have this `RobotTask.robot_class`; None: the G1."""
    for task in tasks:
        found = getattr(find_task(task), "robot_class", None)
        if found is not robot_class:
            own, expected = (
                f"robot class {kind.__qualname__}" if kind else "the G1"
                for kind in (found, robot_class)
            )
            raise UsageError(
                f"task {task} is of {own}, expected one of {expected}: simulate, train and "
                "evaluate each robot by itself"
            )


class BaseInstance:
    """One robot in one episode at a time."""

    scenario: Scenario
    task: Any
    tick: int
    """Planner ticks done in this episode."""
    terminated: bool
    truncated: bool

    @property
    def done(self) -> bool:
        """Whether the episode has ended; physics then stands still."""
        return self.terminated or self.truncated

    @property
    def parameters(self) -> dict[str, float]:
        """The sampled parameters of this episode; ``event_tick`` is -1 without an event."""
        event = self.task.event_tick
        return {**self.task.parameters, "event_tick": -1 if event is None else event}

    @property
    def metadata(self) -> dict[str, Any]:
        """What datasets record of the scenario."""
        return {"event_tick": self.task.event_tick, "scene": self.task.parameters}

    def contacts(self) -> dict[str, bool]:
        """Group of the robot's parts -> whether one of them touched the object in this planner
        tick; empty where contacts are not measured."""
        return {}

    def end_tick(self, action: Array) -> dict[str, float]:
        """Close the planner tick in which ``action`` (A,) was sent: reward terms and flags."""
        if self.done:
            return {}
        self.tick += 1
        terms: dict[str, float] = self.task.end_tick(action)
        self.terminated = self.task.fallen
        self.truncated = not self.terminated and self.task.is_over
        return terms


class BaseVectorEnv(ABC):
    """B robots of one kind, each in its own episode.

    Args:
        config: the options of the tasks, and of the G1.
        num_envs: B.
        robot: the kind of robot.
        sent: actions to keep of each row, the newest among them.

    Raises:
        UsageError: unknown task, wrong shapes, or actions that are not numbers.
    """

    def __init__(self, config: EnvConfig, num_envs: int, robot: RobotSpec, sent: int = 1) -> None:
        if num_envs < 1 or config.threads < 1:
            raise UsageError(
                f"num_envs and threads count from 1, found {num_envs} and {config.threads}"
            )
        self.config, self.num_envs, self.robot = config, num_envs, robot
        self.instances: list[Any] = []
        """The robots and their episodes."""
        # newest first: sent actions that may not have taken effect yet
        self._sent = np.zeros((num_envs, sent, robot.action_dim))

    @property
    @abstractmethod
    def controller_id(self) -> str:
        """Identity of the robot's low-level controller."""

    def _check(self, scenarios: Sequence[Scenario]) -> None:
        """Raise `UsageError` unless this environment can play the scenarios."""
        require_robot(self.robot, [scenario.task for scenario in scenarios])

    @abstractmethod
    def _instance(self, scenario: Scenario) -> Any:
        """A new instance that plays a scenario."""

    def _begin(self, rows: NDArray[np.intp] | None) -> Observation:
        """Complete the start of episodes in ``rows``, None: in all."""
        self._sent[slice(None) if rows is None else rows] = 0.0
        return self._observe()

    @abstractmethod
    def step(self, action: NDArray[np.floating]) -> StepResult:
        """Send one normalised action (B, A) per row and let a planner tick pass."""

    @abstractmethod
    def _observe(self) -> Observation:
        """The observations of all rows."""

    @abstractmethod
    def _in_range(self, position: Array) -> bool:
        """Whether ``position`` (3,), m, base frame, is within the range of the depth camera, and of
        the G1 also in front of the pelvis; the field of view is ignored."""

    @reporting_plugin_errors()
    def known_objects(self) -> NDArray[np.float32]:
        """(B, 4) position of each task's object, m, base frame, and 1; or zeros.

        An object is known while it is within the depth range, of the G1 also in front of it, and
        still matters to the task.
        """
        found = np.zeros((self.num_envs, OBJECT_DIM), np.float32)
        for row, task in enumerate(instance.task for instance in self.instances):
            if self._in_range(position := task.object_b) and not task.finished:
                found[row] = *position, 1.0
        return found

    def damp(self, row: int) -> None:
        """Damp the motors of ``row`` until its next episode."""
        self.instances[row].robot.damp()

    def close(self) -> None:  # noqa: B027 - optional
        """End the threads."""

    @property
    def parameters(self) -> tuple[dict[str, float], ...]:
        """Sampled parameters of each row's episode: physics, delays, geometry."""
        return tuple(instance.parameters for instance in self.instances)

    @property
    def sent_action(self) -> Array:
        """(B, A) the last action sent; neutral at the start of an episode."""
        return self._sent[:, 0].copy()

    @property
    def tick(self) -> NDArray[np.int64]:
        """(B,) planner ticks done in each episode."""
        return np.array([instance.tick for instance in self.instances])

    @property
    def done(self) -> NDArray[np.bool_]:
        """(B,) rows whose episode is over."""
        return np.array([instance.done for instance in self.instances])

    @reporting_plugin_errors()
    def reset(self, scenarios: Sequence[Scenario]) -> Observation:
        """Start an episode in every row."""
        if len(scenarios) != self.num_envs:
            raise UsageError(f"expected {self.num_envs} scenarios, found {len(scenarios)}")
        if self.instances:
            return self.reset_rows(range(self.num_envs), scenarios)
        self._check(scenarios)
        self.instances = [self._instance(scenario) for scenario in scenarios]
        return self._begin(None)

    @reporting_plugin_errors()
    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> Observation:
        """Start a new episode in some rows, the others stay as they are."""
        if not self.instances:
            raise UsageError("reset_rows before the first reset; call reset first")
        if len(rows) != len(scenarios):
            raise UsageError(f"expected {len(rows)} scenarios, found {len(scenarios)}")
        self._check(scenarios)
        for row, scenario in zip(rows, scenarios, strict=True):
            self.instances[row].start(scenario)
        return self._begin(np.asarray(rows, dtype=np.intp))

    def _send(self, action: NDArray[np.floating], live: NDArray[np.bool_]) -> None:
        """Limit the rate, clip to the box, and queue the action."""
        wanted = np.asarray(action, dtype=np.float64)
        expected = (self.num_envs, self.robot.action_dim)
        if wanted.shape != expected:
            raise UsageError(f"expected actions of shape {expected}, found {wanted.shape}")
        if not np.all(np.isfinite(wanted)):
            rows = np.flatnonzero(~np.isfinite(wanted).all(axis=1))
            raise UsageError(f"actions must be finite, found NaN or Inf in rows {rows.tolist()}")
        last = self._sent[:, 0]
        limited = last + np.clip(wanted - last, -ACTION_RATE_LIMIT, ACTION_RATE_LIMIT)
        sent = np.where(live[:, None], np.clip(limited, -1.0, 1.0), last)
        self._sent = np.concatenate([sent[:, None], self._sent[:, :-1]], axis=1)

    def _result(self, terms: list[dict[str, float]]) -> StepResult:
        names = dict.fromkeys(
            name for instance in self.instances for name in instance.task.reward_terms
        )
        by_name = {name: np.array([t.get(name, 0.0) for t in terms]) for name in names}
        return StepResult(
            observation=self._observe(),
            reward=np.sum(list(by_name.values()), axis=0),
            reward_terms=by_name,
            terminated=np.array([instance.terminated for instance in self.instances]),
            truncated=np.array([instance.truncated for instance in self.instances]),
            success=np.array([instance.task.success for instance in self.instances]),
            sent_action=self.sent_action,
            parts=tuple(instance.task.parts for instance in self.instances),
        )
