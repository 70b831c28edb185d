"""Configuration of the simulated robot: scenes, sensors and randomisation.

Ranges are (low, high), sampled uniformly once per episode. The bounds of an option are what the
physics can simulate, not what is sensible to train on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, is_dataclass, replace
from typing import Final, Literal

from egovcp.bounds import MAX_PER_CORE, bounded, check_bounds
from egovcp.errors import UsageError, suggest
from egovcp.hardware import require_memory
from egovcp.spec import TASKS

Range = tuple[float, float]
#: Longest episode, planner ticks of 40 ms.
MAX_TICKS: Final = 10_000
#: Greatest coefficient of a reward term; larger ones lose the others in float32.
MAX_REWARD: Final = 1000
#: m/s towards the wall, calibrated with ``benchmarks/tasks.py`` for controllers that do not step
#: (``stance``) and that do (``walk``).
STANDING_PUSHES: Range = (0.40, 0.60)
STEPPING_PUSHES: Range = (0.80, 1.20)
#: s after a push in which bracing is rewarded, likewise.
STANDING_DISTURBED = 6.0
STEPPING_DISTURBED = 2.0
_ROBOT_BYTES: Final = 900_000  # MuJoCo state of one robot and its scene, measured


def _check_ranges(where: str, part: object) -> None:
    """Refuse a (low, high) pair that is the wrong way round."""
    for name, value in vars(part).items():
        match value:
            case (int() | float() as low, int() | float() as high) if low > high:
                raise UsageError(
                    f"expected low <= high, found {low} > {high} in env.{where}.{name}"
                )


@dataclass(frozen=True)
class EpisodeConfig:
    """Length of an episode and the time of its event, in planner ticks of 40 ms."""

    ticks: int = bounded(150, least=1, most=MAX_TICKS)
    """Time limit, planner ticks; reaching it truncates the episode."""
    event_ticks: tuple[int, int] = bounded((20, 60), least=0, most=MAX_TICKS)
    """First and last tick at which the throw, the push or the arch may start."""
    empty_probability: float = bounded(0.1, least=0, most=1)
    """Share of episodes without an event, from which resting is learned."""


@dataclass(frozen=True)
class BallConfig:
    """A ball thrown at the upper body; a first contact with hand or wrist blocks it."""

    shape: Literal["sphere", "box"] = "sphere"
    """Shape: a ball, or a tumbling cube of the same volume."""
    radius_range: Range = bounded((0.09, 0.12), least=0.01, most=0.3)
    """Radius of the ball, m."""
    mass_range: Range = bounded((0.15, 0.35), least=0.001, most=10)
    """Mass of the ball, kg."""
    distance_range: Range = bounded((2.5, 3.5), least=0.6, most=10)
    """Horizontal distance of the release point from the pelvis, m."""
    bearing_range: Range = bounded((-0.30, 0.30), least=-math.pi, most=math.pi)
    """Direction of the release point seen from the pelvis, rad, 0 is straight ahead."""
    release_height_range: Range = bounded((0.7, 1.4), least=0.1, most=5)
    """Height of the release point above ground, m."""
    flight_range: Range = bounded((0.65, 0.95), least=0.2, most=5)
    """Time from release to the aim point, s."""
    aim_forward: float = bounded(0.10, least=-1, most=1)
    """Aim point in front of the pelvis, m, heading frame."""
    aim_lateral_range: Range = bounded((-0.40, 0.40), least=-2, most=2)
    """Aim point left of the pelvis, m, heading frame."""
    aim_height_range: Range = bounded((0.10, 0.50), least=-1, most=2)
    """Aim point above the pelvis, m."""
    grace: float = bounded(0.3, least=0, most=60)
    """Contacts within this time after a block do not count, s."""
    block_reward: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, at a first contact with a hand or wrist."""
    hit_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, when the ball touches torso, head or leg."""
    pose_cost: float = bounded(0.01, least=0, most=MAX_REWARD)
    """Per tick, times the mean squared action, which is 0 in the neutral pose."""
    fall_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, at a fall."""


@dataclass(frozen=True)
class WallConfig:
    """A wall before the robot, which is pushed towards it; only hands may touch."""

    distance_range: Range = bounded((0.60, 0.70), least=0.3, most=10)
    """Wall surface before the pelvis, m."""
    yaw_range: Range = bounded((-0.10, 0.10), least=-1, most=1)
    """Turn of the wall about the vertical, rad; 0 faces the robot squarely."""
    friction_range: Range = bounded((0.6, 1.0), least=0, most=5)
    """Sliding friction of the wall."""
    push_speed_range: Range | None = bounded(None, least=0, most=5)
    """Change of base velocity by a push towards the wall, m/s. None: calibrated for a controller
    that steps or one that does not (benchmarks/tasks.py)."""
    push_bearing_range: Range = bounded((-0.20, 0.20), least=-math.pi, most=math.pi)
    """Direction of a push towards the wall, rad from straight ahead."""
    away_probability: float = bounded(0.1, least=0, most=1)
    """Share of the pushes that go away from the wall."""
    away_speed_range: Range = bounded((0.05, 0.15), least=0, most=5)
    """Change of base velocity by a push away from the wall, m/s; the stance survives it."""
    push_time: float = bounded(0.02, least=0.005, most=1)
    """Time over which a push acts, s."""
    disturbed_time: float | None = bounded(None, least=0, most=3600)
    """Time after a push in which bracing is rewarded, s. None: 2 s for a controller that steps;
    6 s, the rest of the episode, for one that does not and has to keep leaning on the wall."""
    brace_reward: float = bounded(0.03, least=0, most=MAX_REWARD)
    """Per tick upright with a hand and nothing else on the wall while disturbed."""
    upright_reward: float = bounded(0.02, least=0, most=MAX_REWARD)
    """Per tick upright while disturbed."""
    contact_cost: float = bounded(0.1, least=0, most=MAX_REWARD)
    """Per tick with anything but a hand on the wall."""
    impact_cost: float = bounded(0.05, least=0, most=MAX_REWARD)
    """Per tick, times the peak hand force over ``impact_force``, at most 1 per tick."""
    impact_force: float = bounded(300.0, least=1, most=1e5)
    """Hand force that costs ``impact_cost`` in full, N."""
    pose_cost: float = bounded(0.03, least=0, most=MAX_REWARD)
    """Per tick, times the mean squared action."""
    guard_cost: float = bounded(0.27, least=0, most=MAX_REWARD)
    """Extra pose cost before the push, so that permanently raised hands are not optimal."""
    fall_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, at a fall."""


@dataclass(frozen=True)
class ArchConfig:
    """An arch that an upright robot would hit and a crouched one passes under."""

    motion: Literal["auto", "walk", "rail"] = "auto"
    """`walk`: the robot walks to a fixed arch. `rail`: the arch moves towards the standing robot at
    the commanded speed, for controllers that cannot walk. `auto`: as the controller allows."""
    clearance_range: Range = bounded((1.16, 1.24), least=0.5, most=3)
    """Lower edge of the lintel above ground, m."""
    width_range: Range = bounded((1.1, 1.5), least=0.4, most=10)
    """Free width between the posts, m."""
    depth_range: Range = bounded((0.10, 0.20), least=0.01, most=5)
    """Thickness of posts and lintel along the direction of passage, m."""
    lintel_height: float = bounded(0.35, least=0.01, most=5)
    """Height of the lintel beam, m."""
    distance_range: Range = bounded((1.6, 2.2), least=0.4, most=20)
    """Centre of the arch before the pelvis when it starts to move, m."""
    lateral_range: Range = bounded((-0.08, 0.08), least=-5, most=5)
    """Centre of the arch left of the pelvis, m."""
    speed_range: Range = bounded((0.3, 0.5), least=0.01, most=2)
    """Commanded forward velocity, m/s; the arch moves towards the robot as fast."""
    progress_reward: float = bounded(0.05, least=0, most=MAX_REWARD)
    """Per metre of progress towards and through the arch."""
    pass_reward: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, when the arch has been passed without any contact."""
    head_cost: float = bounded(0.1, least=0, most=MAX_REWARD)
    """Per tick with the head on the arch."""
    contact_cost: float = bounded(0.05, least=0, most=MAX_REWARD)
    """Per tick with any other part on the arch."""
    crouch_cost: float = bounded(0.01, least=0, most=MAX_REWARD)
    """Per tick, times the share of the crouch (0 standing, 1 lowest) away from the arch."""
    near: float = bounded(0.9, least=0, most=20)
    """Crouching is free while the arch is nearer than this, m."""
    pose_cost: float = bounded(0.005, least=0, most=MAX_REWARD)
    """Per tick, times the mean squared action of the hands."""
    fall_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, at a fall."""


@dataclass(frozen=True)
class SequenceConfig:
    """Several tasks in one episode, in turn (--task=sequence)."""

    parts: tuple[str, ...] = ("arch", "ball")
    """Its tasks in their order, each at most once. The wall, on which the robot leans, can only be
    the last."""
    pause_ticks: int = bounded(25, least=0, most=MAX_TICKS)
    """Planner ticks from the end of a part (arch passed, ball on the floor) to the next one. A part
    ends at the latest after the ticks of its own episodes."""

    def __post_init__(self) -> None:
        check_bounds(self)
        for name in self.parts:
            if name not in TASKS:
                known = suggest(name, TASKS)
                raise UsageError(f"unknown task {name!r} in env.sequence.parts{known}")
        if not self.parts or len(set(self.parts)) < len(self.parts) or "wall" in self.parts[:-1]:
            raise UsageError(
                f"env.sequence.parts={list(self.parts)}: expected at least one task, each at most "
                "once, and wall only at the end"
            )


@dataclass(frozen=True)
class CameraConfig:
    """Depth camera on the head, and the noise of its images."""

    position: tuple[float, float, float] = bounded((0.058, 0.0, 0.42), least=-1, most=1)
    """Mount in the torso frame, m."""
    pitch_range: Range = bounded((math.radians(-5.0), 0.0), least=-math.pi / 2, most=math.pi / 2)
    """Tilt below the torso's horizontal, rad, drawn per episode."""
    vertical_fov: float = bounded(math.radians(58.0), least=0.1, most=3)
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
    """Delays, drawn per episode, in whole controller ticks of 20 ms."""

    action_ticks: tuple[int, int] = bounded((0, 2), least=0, most=50)
    """Controller ticks from an action to its effect."""
    image_age: Range = bounded((0.02, 0.08), least=0, most=1)
    """Age of the depth image in an observation, s; rounded to controller ticks."""


@dataclass(frozen=True)
class RandomisationConfig:
    """Ranges of the physical parameters, drawn per episode; (1, 1) switches one off."""

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
class EnvConfig:
    """The simulated robot, its scenes and its sensors."""

    ball: BallConfig = BallConfig()
    """The ball."""
    wall: WallConfig = WallConfig()
    """The wall."""
    arch: ArchConfig = ArchConfig()
    """The arch."""
    ball_episode: EpisodeConfig = EpisodeConfig()
    """Length and timing of ball episodes."""
    wall_episode: EpisodeConfig = EpisodeConfig()
    """Length and timing of wall episodes."""
    arch_episode: EpisodeConfig = EpisodeConfig(ticks=230, event_ticks=(5, 25))
    """Length and timing of arch episodes; the default covers the slowest passage."""
    sequence: SequenceConfig = SequenceConfig()
    """Several tasks in one episode, whose lengths and timings are those of the three above."""
    controller: str = "walk"
    """Low-level controller: walk (trained, ships with the package), stance (LQR, does not step), or
    the walk.safetensors or walk.onnx of egovcp-train-lowlevel."""
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
                _check_ranges(name, part)

    def for_controller(self, walks: bool) -> EnvConfig:
        """The config with the values that depend on whether the controller walks.

        Raises:
            UsageError: the motion of the arch does not suit the controller.
        """
        motion: Literal["walk", "rail"] = "walk" if walks else "rail"
        if self.arch.motion not in ("auto", motion):
            cause = "walks, and would walk to an arch that comes" if walks else "does not walk"
            raise UsageError(
                f"env.arch.motion={self.arch.motion} does not go with the low-level controller "
                f"{self.controller!r}, which {cause}; expected {motion} or auto, or another "
                "--env.controller"
            )
        wall = self.wall
        pushes = wall.push_speed_range or (STEPPING_PUSHES if walks else STANDING_PUSHES)
        disturbed = STEPPING_DISTURBED if walks else STANDING_DISTURBED
        if wall.disturbed_time is not None:
            disturbed = wall.disturbed_time
        return replace(
            self,
            arch=replace(self.arch, motion=motion),
            wall=replace(wall, push_speed_range=pushes, disturbed_time=disturbed),
        )

    def episode(self, task: str) -> EpisodeConfig:
        """Length and timing of an episode of ``task``; of a sequence, the length of all its parts
        and the timing of the first.

        Raises:
            UsageError: the task is unknown.
        """
        episodes = {
            "ball": self.ball_episode,
            "wall": self.wall_episode,
            "arch": self.arch_episode,
        }
        parts = [episodes[name] for name in self.sequence.parts]
        episodes["sequence"] = replace(parts[0], ticks=sum(part.ticks for part in parts))
        if task not in episodes:
            raise UsageError(f"unknown task {task!r}{suggest(task, episodes)}")
        return episodes[task]


def evaluation_config() -> EnvConfig:
    """The defaults with an event in every episode."""
    config = EnvConfig()
    return replace(
        config,
        ball_episode=replace(config.ball_episode, empty_probability=0.0),
        wall_episode=replace(config.wall_episode, empty_probability=0.0),
        arch_episode=replace(config.arch_episode, empty_probability=0.0),
    )


def require_memory_for_robots(option: str, count: int, robots: int | None = None) -> None:
    """Raise `UsageError` unless there is memory to simulate the robots.

    Args:
        option: that sets their number, such as ``--num_envs``.
        count: its value.
        robots: number of robots that this value means; None: ``count``.
    """
    require_memory(f"{option}={count}", _ROBOT_BYTES * (count if robots is None else robots))
