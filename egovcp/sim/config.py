"""Configuration of the simulated robot: scenes, sensors and randomisation.

Ranges are (low, high), sampled uniformly once per episode. The bounds of an option are what the
physics can simulate, not what is sensible to train on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, is_dataclass, make_dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal

from egovcp.bounds import MAX_PER_CORE, bounded, check_bounds, check_ranges
from egovcp.errors import UsageError
from egovcp.hardware import require_memory
from egovcp.sim.tasks.options import MAX_REWARD, EpisodeConfig, Range
from egovcp.sim.tasks.registry import find_task, task_entries
from egovcp.spec import (
    ACTION_RATE_COST,
    CAMERA_PITCH_RANGE,
    CAMERA_POSITION,
    CAMERA_VERTICAL_FOV,
    POSE_COST,
)

_ROBOT_BYTES: Final = 900_000  # MuJoCo state of one robot and its scene, measured


@dataclass(frozen=True)
class CameraConfig:
    """Depth camera on the head, and the noise of its images."""

    position: tuple[float, float, float] = bounded(CAMERA_POSITION, least=-1, most=1)
    """Mount in the torso frame, m."""
    pitch_range: Range = bounded(CAMERA_PITCH_RANGE, least=-math.pi / 2, most=math.pi / 2)
    """Tilt below the torso's horizontal, rad, drawn per episode. The default looks up by 10 to 15
    degrees, which keeps thrown balls in the image (docs/data.md)."""
    vertical_fov: float = bounded(CAMERA_VERTICAL_FOV, least=0.1, most=3)
    """Vertical field of view, rad; pixels are square."""
    noise_per_z2: Range = bounded((0.001, 0.004), least=0, most=1)
    """Standard deviation of depth over depth squared, 1/m (stereo noise grows with z^2)."""
    hole_probability: Range = bounded((0.0, 0.01), least=0, most=1)
    """Share of pixels lost at random."""
    edge_probability: Range = bounded((0.0, 0.25), least=0, most=1)
    """Share of pixels lost beside a depth discontinuity."""
    edge_ratio: float = bounded(0.12, above=0, most=1)
    """Neighbours whose depths differ by this share of the greater make a discontinuity."""


@dataclass(frozen=True)
class SensorConfig:
    """Standard deviations of proprioception, white, per 20 ms measurement."""

    angular_velocity: float = bounded(0.03, least=0, most=10)
    """rad/s."""
    gravity: float = bounded(0.005, least=0, most=1)
    """Of each component of the projected gravity, which stays a unit vector."""
    joint_position: float = bounded(0.002, least=0, most=1)
    """rad."""
    joint_velocity: float = bounded(0.05, least=0, most=10)
    """rad/s."""


@dataclass(frozen=True)
class DelayConfig:
    """Delays, drawn per episode and rounded to controller ticks of 20 ms."""

    action_ticks: tuple[int, int] = bounded((0, 2), least=0, most=50)
    """Controller ticks from an action to its effect."""
    image_age: Range = bounded((0.02, 0.08), least=0, most=1)
    """Age of the depth image in an observation, s; rounded to controller ticks."""


@dataclass(frozen=True)
class RandomisationConfig:
    """Ranges of the physical parameters, drawn per episode. A range of one value, such as (1, 1)
    for a factor or (0, 0) for the payload, fixes it."""

    friction: Range = bounded((0.6, 1.0), least=0.01, most=5)
    """Sliding friction of the feet; the simulation diverges without any."""
    payload: Range = bounded((-0.5, 1.5), least=-2, most=30)
    """Mass added to the torso, kg."""
    mass_scale: Range = bounded((0.97, 1.03), least=0.5, most=2)
    """Factor on every mass of the robot."""
    stiffness_scale: Range = bounded((0.95, 1.05), least=0.1, most=5)
    """Factor on the servo stiffness."""
    damping_scale: Range = bounded((0.9, 1.1), least=0.1, most=5)
    """Factor on the servo damping."""
    initial_joint: float = bounded(0.01, least=0, most=1)
    """Half width of the uniform offset on the joints of waist and arms at the start, rad."""


@dataclass(frozen=True)
class BaseEnvConfig:
    """The simulated robot and its sensors, without the options of tasks."""

    pose_cost: float = bounded(POSE_COST, least=0, most=MAX_REWARD)
    """Per planner tick in every task, times the mean squared action, which is 0 in the neutral
    pose."""
    action_rate_cost: float = bounded(ACTION_RATE_COST, least=0, most=MAX_REWARD)
    """Per planner tick in every task, times the mean squared change of the action, where 1 is the
    largest change."""
    controller: str = "walk"
    """Low-level controller: walk (trained, ships with the package), stance (LQR, does not step, for
    ball and wall only), or the walk.safetensors of egovcp-train-lowlevel."""
    feet: Literal["stock", "points"] = "points"
    """Foot collision model: four points each (about twice as fast), or the stock capsules."""
    camera: CameraConfig = CameraConfig()
    """Depth camera."""
    sensors: SensorConfig = SensorConfig()
    """Noise of proprioception."""
    delay: DelayConfig = DelayConfig()
    """Latency of action and image."""
    randomise: RandomisationConfig = RandomisationConfig()
    """Physical parameters."""
    threads: int = bounded(1, least=1, most=1024, per_core=MAX_PER_CORE)
    """Threads that step physics and cast rays; results do not depend on it."""

    def __post_init__(self) -> None:
        check_bounds(self)
        for name, part in vars(self).items():
            if is_dataclass(part):
                check_ranges(f"env.{name}", part)
        for task in _tasks():
            task.check_options(self)

    def options_of(self, task: str) -> Any:
        """The options of a task, ``--env.<task>``; the defaults of one that was registered late."""
        return getattr(self, task, find_task(task).config)

    def require_walking(self, task: str, walks: bool) -> None:
        """Raise `UsageError` if ``task`` needs a controller that walks, and this one does not."""
        if not walks and find_task(task).walks(self):
            raise UsageError(
                f"task {task}: the robot walks in it, but the low-level controller "
                f"{self.controller!r} does not walk; expected one that walks: use "
                "--env.controller=walk, or another task"
            )

    def episode(self, task: str) -> EpisodeConfig:
        """Length and timing of an episode of ``task``; of a sequence, the length of all its parts
        and the timing of the first.

        Raises:
            UsageError: the task is unknown.
        """
        return find_task(task).episode_config(self)


if TYPE_CHECKING:
    from egovcp.sim.tasks.base_task import BaseTask

    class EnvConfig(BaseEnvConfig):
        """See `_env_config`."""

        def __init__(self, **options: Any) -> None: ...

        def __getattr__(self, task: str) -> Any: ...

else:

    def __getattr__(name: str) -> object:
        """Create `EnvConfig` at its first use: it imports plugins, which import this package."""
        if name != "EnvConfig":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return _env_config(_tasks())


def _tasks() -> tuple[type[BaseTask], ...]:
    return tuple(entry.task for entry in task_entries() if entry.task is not None)


@cache
def _env_config(tasks: tuple[type[BaseTask], ...]) -> type[BaseEnvConfig]:
    """`BaseEnvConfig` with the options ``<task>`` and ``<task>_episode`` of every task."""
    options = []
    for task in tasks:
        options.append((task.name, type(task.config), field(default=task.config)))
        if task.episode is not None:
            default = field(default=task.episode)
            options.append((f"{task.name}_episode", EpisodeConfig, default))
    about = {"__doc__": "The simulated robot, its scenes and its sensors."}
    return make_dataclass(
        "EnvConfig",
        options,
        bases=(BaseEnvConfig,),
        namespace=about,
        frozen=True,
        module=__name__,
    )


def with_episodes(change: Callable[[type[BaseTask], EpisodeConfig], EpisodeConfig]) -> EnvConfig:
    """The default environment, with the episodes of each task changed."""
    tasks = _tasks()
    config: Any = _env_config(tasks)()
    episodes = {
        f"{task.name}_episode": change(task, task.episode) for task in tasks if task.episode
    }
    changed: EnvConfig = replace(config, **episodes)
    return changed


def evaluation_config() -> EnvConfig:
    """The defaults with an event in every episode."""
    return with_episodes(lambda task, episode: replace(episode, empty_probability=0.0))


def short_episodes() -> EnvConfig:
    """The environment of training data: the event comes soon, and its end ends the episode."""
    return with_episodes(lambda task, episode: task.short_episode or episode)


def require_memory_for_robots(option: str, count: int, robots: int | None = None) -> None:
    """Raise `UsageError` unless there is memory to simulate the robots.

    Args:
        option: that sets their number, such as ``--num_envs``.
        count: its value.
        robots: number of robots that this value means; None: ``count``.
    """
    require_memory(f"{option}={count}", _ROBOT_BYTES * (count if robots is None else robots))
