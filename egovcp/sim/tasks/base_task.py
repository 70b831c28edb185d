"""What tasks of all robots share: description, reward terms, success, length of an episode."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure
from egovcp.robot_spec import RobotSpec
from egovcp.sim.tasks.options import EpisodeConfig, TaskConfig
from egovcp.spec import ACTION_RATE_LIMIT, Solid

if TYPE_CHECKING:
    from egovcp.sim.config import BaseEnvConfig, EnvConfig
    from egovcp.sim.scenario import Scenario

Array = NDArray[np.float64]


class BaseTask(ABC):
    """One episode of a task of any robot; see `Task` (of the G1) and `RobotTask`."""

    name: ClassVar[str]
    """Name of the task in commands, datasets and options: lower-case letters, digits, ``_``."""
    description: ClassVar[str]
    """What the robot has to do, in one line; cards show it."""
    terms: ClassVar[Mapping[str, str]]
    """Reward term -> the column of ``spec.REWARD_TERMS`` in which datasets store it: ``block`` (a
    wanted contact), ``pass`` (another achievement) or ``hit`` (an unwanted contact or state).
    A name consists of lower-case letters, digits and ``_``; ``fall`` and ``spec.ACTION_TERMS`` are
    terms of every task."""
    config: Any = TaskConfig()
    """Options of the task, ``--env.<name>.*``: a frozen dataclass derived from `TaskConfig`. The
    value of the class holds the defaults, that of an instance the options of the environment."""
    event: ClassVar[str] = "event"
    """What the event is called in logs, such as ``robot pushed``."""
    episode: ClassVar[EpisodeConfig | None] = EpisodeConfig()
    """Default of ``--env.<name>_episode.*``; None: there are no such options."""
    short_episode: ClassVar[EpisodeConfig | None] = None
    """Its default in ``egovcp-collect``, where the event comes soon; None: `episode`."""
    event_duration_ticks: ClassVar[int] = 50
    """Planner ticks that an event takes; figures show these."""
    needs_walking: ClassVar[bool] = False
    """Whether `velocity_command` is not always zero."""
    in_sequence: ClassVar[Literal["no", "anywhere", "last"]] = "no"
    """Whether the task can be part of a sequence, which requires `park` and `finished`."""
    for_training: ClassVar[bool] = True
    """Whether datasets of the task can be collected; ``--task=all`` has all these tasks."""
    seed_key: ClassVar[int | None] = None
    """Key of the task's random streams; None: derived from `name`. Fixed for egovcp's own tasks,
    whose scenarios do not depend on their names."""

    @classmethod
    @abstractmethod
    def robot_spec(cls) -> RobotSpec:
        """The robot that does the task."""

    @classmethod
    @abstractmethod
    def physics_clock(cls) -> tuple[float, int]:
        """Duration of a physics step, s, and physics steps per planner tick."""

    @classmethod
    @abstractmethod
    def constant_actions(cls) -> list[tuple[float, ...]]:
        """Candidates of the search for the best constant action, without the neutral one."""

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: Any) -> None:
        self.config = config.options_of(self.name)
        self.scenario = scenario
        self._step_s, self._tick_steps = self.physics_clock()
        self.robot = robot
        self.parameters: dict[str, float] = {}
        """Sampled parameters of this episode, SI units."""
        self._pose_cost, self._action_rate_cost = config.pose_cost, config.action_rate_cost
        self._last_action: Array = np.zeros(self.robot_spec().action_dim)
        self._counted: set[str] = set()  # terms that occur once and have occurred
        episode = config.episode(self.name)
        rng = scenario.rng("event")
        low, high = episode.event_ticks
        tick = int(rng.integers(low, high + 1))
        empty = bool(rng.random() < episode.empty_probability)
        self.event_tick: int | None = None if empty else tick
        self._geometry_rng = scenario.rng("geometry")
        self.ticks_limit = episode.ticks
        self.physics_steps = 0
        self.fallen = False

    # --- the task ------------------------------------------------------------------------
    @classmethod
    @abstractmethod
    def add_objects(cls, spec: mujoco.MjSpec) -> None:
        """Add the task's bodies to the scene, out of sight; called once per process.

        A geom collides with the robot if its ``contype`` is 1. Shapes that vary between episodes
        are set in ``__init__`` with `SimulatedRobot.shape_geom`.
        """

    @abstractmethod
    def place(self) -> None:
        """Place the objects for the start of the episode, around the standing robot."""

    def before_step(self) -> None:  # noqa: B027 - optional
        """Move objects or push the robot, before a physics step; by default nothing."""

    @abstractmethod
    def rewards(self) -> dict[str, float]:
        """The `terms` of the planner tick; finite."""

    @property
    @abstractmethod
    def achieved(self) -> bool:
        """`success`, regardless of falls. It never ends an episode."""

    @property
    @abstractmethod
    def object_w(self) -> Array:
        """(3,) the point that matters, m, world: such as the centre of a ball or the nearest point
        of a wall; NaN while there is none. The world model learns to locate it in the images."""

    def oracle(self) -> Array:
        """(A,) action of the scripted solution, which may use the whole state of the simulator.

        Optional; see `has_oracle`.
        """
        raise self.error("it has no oracle")

    def park(self) -> None:  # noqa: B027 - optional
        """Move the objects out of sight and reach; see `in_sequence`."""

    def require_position(self) -> Array:
        """`object_w`.

        Raises:
            EnvironmentFailure: it is not an array (3,).
        """
        position = np.asarray(self.object_w, np.float64)
        if position.shape != (3,):
            raise self.error(f"its object_w has shape {position.shape}, expected (3,)")
        return position

    @property
    def finished(self) -> bool:
        """Whether the object no longer matters, such as a ball on the floor."""
        return False

    @abstractmethod
    def solids(self) -> tuple[Solid, ...]:
        """Shapes in the scene that recordings show."""

    # --- what a task may use -------------------------------------------------------------
    def sample(self, *names: str) -> dict[str, float]:
        """Sample ``names`` uniformly from the config's ranges ``<name>_range``, in this order.

        They are `parameters` of the episode. Further calls continue the random stream.
        """
        rng = self._geometry_rng
        for name in names:
            limits = getattr(self.config, f"{name}_range", None)
            if limits is None:
                raise self.error(f"sample({name!r}), but its config has no {name}_range")
            self.parameters[name] = float(rng.uniform(*limits))
        return self.parameters

    def once(self, term: str, due: bool) -> bool:
        """Whether ``due`` is true for the first time, so that ``term`` counts once."""
        first = due and term not in self._counted
        if first:
            self._counted.add(term)
        return first

    @property
    def time(self) -> float:
        """Seconds since the start of the episode."""
        return self.physics_steps * self._step_s

    @property
    def since_event(self) -> float:
        """Seconds since the event; negative before it, -inf in an empty episode."""
        if self.event_tick is None:
            return -np.inf
        return (self.physics_steps - self.event_tick * self._tick_steps) * self._step_s

    # --- the episode, driven by the environment ------------------------------------------
    @property
    def reward_terms(self) -> Mapping[str, str]:
        """All reward terms, whose sum is the reward, and their columns; see `terms`."""
        return {**self.terms, "fall": "fall", "pose": "pose", "action_rate": "action_rate"}

    @property
    def is_over(self) -> bool:
        """Whether the time limit is reached."""
        return self.physics_steps >= self.ticks_limit * self._tick_steps

    @property
    def current_name(self) -> str:
        """Name of the current task, whose object `object_w` is."""
        return self.name

    @property
    def success(self) -> bool:
        """Whether the task would count as achieved if the episode ended now.

        Raises:
            EnvironmentFailure: `achieved` of the task is no truth value.
        """
        achieved: Any = self.achieved
        if not isinstance(achieved, bool | np.bool_):
            raise self.error(f"its achieved is {achieved!r}; expected True or False")
        return bool(achieved) and not self.fallen

    @property
    def parts(self) -> dict[str, bool]:
        """Success of each part of a sequence; empty for a single task."""
        return {}

    @property
    def fall_cost(self) -> float:
        """Cost of a fall."""
        return float(self.config.fall_cost)

    def begin_tick(self) -> None:  # noqa: B027 - optional
        """Reset the quantities of a planner tick."""

    def end_tick(self, action: Array) -> dict[str, float]:
        """Reward terms of the planner tick in which ``action`` (A,) was sent.

        Raises:
            EnvironmentFailure: the task returns other terms than it declares, or values that are
                no finite numbers.
        """
        was_fallen, self.fallen = self.fallen, self.fallen or self.has_fallen()
        rewards: Any = self.rewards()
        if not isinstance(rewards, dict):
            raise self.error(f"its rewards are {rewards!r}; expected a dict, reward term -> number")
        terms: dict[str, float] = dict(rewards)
        terms["fall"] = -self.fall_cost if self.fallen and not was_fallen else 0.0
        terms["pose"] = -self._pose_cost * float(np.mean(action**2))
        change = (action - self._last_action) / ACTION_RATE_LIMIT
        terms["action_rate"] = -self._action_rate_cost * float(np.mean(change**2))
        self._last_action = action.copy()
        if terms.keys() != self.reward_terms.keys():
            found = ", ".join(terms)
            raise self.error(f"its rewards are {found}; expected {', '.join(self.reward_terms)}")
        for name, value in terms.items():
            if not isinstance(value, Real) or not math.isfinite(value):
                raise self.error(
                    f"its reward term {name} is {value} after {self.time:.2f} s; expected a finite "
                    "number"
                )
        return terms

    @abstractmethod
    def has_fallen(self) -> bool:
        """Whether the episode has failed: the robot fell, or cannot go on."""

    @classmethod
    def has_oracle(cls) -> bool:
        """Whether the task defines `oracle`."""
        return cls.oracle is not BaseTask.oracle

    @classmethod
    def scene_tasks(cls, config: BaseEnvConfig) -> tuple[type[Any], ...]:
        """The tasks whose objects are in the scene, in the order in which they are added."""
        return (cls,)

    @classmethod
    def walks(cls, config: BaseEnvConfig) -> bool:
        """Whether the task needs a low-level controller that walks."""
        return cls.needs_walking

    @classmethod
    def episode_config(cls, config: BaseEnvConfig) -> EpisodeConfig:
        """Length and timing of an episode."""
        found = getattr(config, f"{cls.name}_episode", cls.episode)
        assert isinstance(found, EpisodeConfig), f"{cls.name} has no episode options"
        return found

    @classmethod  # noqa: B027 - optional
    def check_options(cls, config: BaseEnvConfig) -> None:
        """Raise `UsageError` for options that make no sense; ``config`` has those of all tasks."""

    @classmethod
    def error(cls, problem: str) -> EnvironmentFailure:
        """The error of a defective task; the message names the class and what to do."""
        reference = f"{cls.__module__}:{cls.__qualname__}"
        return EnvironmentFailure(
            f"task {cls.name} ({reference}): {problem}; repair the class, then run egovcp-task "
            f"check {reference}"
        )

    def _solid(self, geom: int) -> Solid:
        model, data = self.robot.model, self.robot.data
        kind = int(model.geom_type[geom])
        is_sphere = kind == mujoco.mjtGeom.mjGEOM_SPHERE
        # of other shapes than sphere and box: the bounding box
        half = model.geom_size if kind == mujoco.mjtGeom.mjGEOM_BOX else model.geom_aabb[:, 3:]
        x, y, z = (float(size) for size in half[geom])
        quaternion = np.empty(4)
        mujoco.mju_mulQuat(quaternion, data.xquat[model.geom_bodyid[geom]], model.geom_quat[geom])
        return Solid(
            name=model.geom(geom).name or f"{model.body(model.geom_bodyid[geom]).name}_{geom}",
            shape="sphere" if is_sphere else "box",
            size=(x, y, z),
            position_w=data.geom_xpos[geom].copy(),
            quaternion_w=quaternion,
        )
