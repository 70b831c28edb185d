"""Options of the low-level training: task, networks, PPO and curriculum.

The difficulty is a number in [0, 1] that rises with success. Options with an easy and a hard range
are interpolated between both.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from egovcp.bounds import OutOfBounds, bounded, check_bounds, check_ranges

Range = tuple[float, float]


def _weight(default: float) -> float:
    return bounded(default, least=-1e4, most=1e4)


@dataclass(frozen=True)
class CommandConfig:
    """The commands of training episodes; a new one every few seconds."""

    interval: Range = bounded((2.0, 6.0), least=0.02, most=3600)
    """Interval between commands, s."""
    standing: float = bounded(0.4, least=0, most=1)
    """Share of commands with zero velocity."""
    forward: tuple[Range, Range] = bounded(((0.1, 0.3), (0.1, 0.8)), least=-3, most=3)
    """Speed forwards, m/s, easy and hard."""
    backward: float = bounded(0.15, least=0, most=1)
    """Share of the walking commands that are not in place (`in_place`) that go backwards."""
    backward_speed: tuple[Range, Range] = bounded(((0.1, 0.15), (0.1, 0.35)), least=0, most=3)
    """Speed backwards, m/s, easy and hard."""
    in_place: float = bounded(0.25, least=0, most=1)
    """Share of the walking commands that go neither forwards nor backwards, only sideways or
    turning."""
    sideways: float = bounded(0.25, least=0, most=3)
    """Largest speed sideways, m/s, at difficulty 1; in half of the commands in place and a third of
    the other walking commands."""
    turning: float = bounded(0.7, least=0, most=5)
    """Largest yaw rate, rad/s, at difficulty 1; in half of the commands in place and a third of the
    other walking commands."""
    standing_height: tuple[Range, Range] = bounded(((0.65, 0.75), (0.50, 0.76)), least=0.3, most=1)
    """Pelvis height while standing, m, easy and hard."""
    walking_height: tuple[Range, Range] = bounded(((0.70, 0.75), (0.52, 0.75)), least=0.3, most=1)
    """Pelvis height while walking, m, easy and hard."""
    acceleration: float = bounded(0.8, least=0.01, most=100)
    """Acceleration of the commanded velocity, m/s^2 and rad/s^2."""
    still_hands: float = bounded(0.2, least=0, most=1)
    """Share of commands with resting hands; the others follow a random walk."""
    held_hands: float = bounded(0.4, least=0, most=1)
    """Share of those random walks that hold each target for 5 to 15 planner steps; the others
    change at every planner step, as in the paper."""

    def __post_init__(self) -> None:
        check_bounds(self)
        check_ranges("task.commands", self)


@dataclass(frozen=True)
class DisturbanceConfig:
    """Pushes, physical parameters and delay."""

    push_interval: Range = bounded((3.0, 8.0), least=0.02, most=3600)
    """Interval between pushes, s."""
    push: Range = bounded((0.1, 0.8), least=0, most=5)
    """Largest change of the horizontal velocity by a push, m/s, easy and hard."""
    wall: float = bounded(0.5, least=0, most=1)
    """Share of the pushes of a standing robot that go towards a wall, on which it may brace with
    its hands; only on the CPU, the mjlab task has no walls."""
    wall_push: tuple[Range, Range] = bounded(((0.2, 0.4), (0.3, 1.3)), least=0, most=5)
    """Change of the velocity by a push towards the wall, m/s, easy and hard."""
    friction: Range = bounded((0.5, 1.1), least=0.01, most=5)
    """Sliding friction of the feet."""
    payload: Range = bounded((-0.5, 2.0), least=-2, most=30)
    """Payload on the torso, kg."""
    mass_scale: Range = bounded((0.95, 1.05), least=0.5, most=2)
    """Factor on every mass."""
    stiffness_scale: Range = bounded((0.8, 1.2), least=0.1, most=5)
    """Factor on the stiffness of every joint."""
    damping_scale: Range = bounded((0.8, 1.2), least=0.1, most=5)
    """Factor on the damping of every joint."""
    delay: Range = bounded((0.0, 0.02), least=0, most=0.04)
    """Delay from a measurement until the new joint targets act, s, rounded to physics steps."""
    models: int = bounded(64, least=1, most=4096)
    """Robots of different physical parameters."""

    def __post_init__(self) -> None:
        check_bounds(self)
        check_ranges("task.disturbances", self)


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward terms, per second; * marks the reference of a quantity."""

    alive: float = _weight(0.5)
    """1 at every tick."""
    velocity: float = _weight(3.0)
    """exp(-|v - v*|^2 / 0.03) of the horizontal velocity v, m/s, averaged over 0.3 s."""
    turning: float = _weight(1.0)
    """exp(-(w - w*)^2 / 0.1) of the yaw rate w, rad/s, averaged over 0.3 s."""
    height: float = _weight(1.0)
    """exp(-(z - z*)^2 / 0.001) of the pelvis height z, m."""
    upright: float = _weight(1.0)
    """exp(-|u - u*|^2 / 0.03) of the vertical u in the pelvis frame; u*: at the natural pitch."""
    contact: float = _weight(1.0)
    """Share of the feet that stand or swing as the phase of the gait requires."""
    stepping: float = _weight(-1.0)
    """Amount of gait, 0 to 1, without a commanded velocity; 0 in the 2 s after a push."""
    torso_rate: float = _weight(-0.6)
    """Squared angular velocity of the torso beyond the commanded turning, rad^2/s^2, at most 10."""
    torso_change: float = _weight(-0.2)
    """Squared change of that angular velocity over a planner step, rad^2/s^2, at most 10."""
    slip: float = _weight(-0.5)
    """Squared horizontal velocity of each standing foot, m^2/s^2, at most 4, summed."""
    stance_width: float = _weight(-5.0)
    """By how much the lateral distance of the feet is below 0.16 m, m."""
    foot_heading: float = _weight(-1.0)
    """Squared sine of the yaw of each foot in the heading frame, summed."""
    action: float = _weight(-0.02)
    """Squared norm of the policy's action."""
    action_rate: float = _weight(-0.02)
    """Squared norm of the change of the action per tick."""
    torque: float = _weight(-1.0)
    """Mean of (torque / limit)^2 over the joints of legs and waist."""
    fall: float = _weight(-100.0)
    """1 at the tick of a fall."""


@dataclass(frozen=True)
class LowLevelTask:
    """Commands, disturbances and rewards."""

    commands: CommandConfig = field(default_factory=CommandConfig)
    """Commands."""
    disturbances: DisturbanceConfig = field(default_factory=DisturbanceConfig)
    """Pushes, physical parameters and delay."""
    rewards: RewardConfig = field(default_factory=RewardConfig)
    """Weights of the reward terms."""
    episode: float = bounded(20.0, least=0.02, most=3600)
    """Longest episode, s."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of actor and critic."""

    actor: tuple[int, ...] = bounded((256, 128, 64), least=1, most=8192, longest=16)
    """Hidden layers of the policy."""
    critic: tuple[int, ...] = bounded((256, 128, 64), least=1, most=8192, longest=16)
    """Hidden layers of the critic, which also reads the true state of the simulation."""
    initial_std: float = bounded(0.3, above=0)
    """Initial standard deviation of the policy's actions."""

    def __post_init__(self) -> None:
        for name in ("actor", "critic"):
            if not getattr(self, name):
                raise OutOfBounds(name, (), "at least one layer")


@dataclass(frozen=True)
class CurriculumConfig:
    """Curriculum: when the task becomes harder."""

    start: float = bounded(0.0, least=0, most=1)
    """Difficulty of the first iteration."""
    step: float = bounded(0.004, least=0)
    """Change of the difficulty per iteration."""
    low_fall_rate: float = bounded(0.02, least=0, most=1)
    """Falls per robot and second below which the task becomes harder."""
    high_fall_rate: float = bounded(0.08, least=0, most=1)
    """Falls per robot and second above which it becomes easier."""
    tracking: float = bounded(0.65, least=0)
    """Mean velocity reward (1: perfect) above which the task becomes harder."""
