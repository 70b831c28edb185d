"""What the low-level policy is asked to do and rewarded for; one place for CPU and GPU training.

The difficulty is a number in [0, 1] that rises with success. Ranges are given at both ends
and interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from egovcp.bounds import bounded, check_bounds
from egovcp.errors import UsageError

Range = tuple[float, float]


def _check_ranges(where: str, config: object) -> None:
    """Refuse a (low, high) pair that is the wrong way round, nested ones too."""
    for name, value in vars(config).items():
        pairs = value if isinstance(value, tuple) and isinstance(value[0], tuple) else (value,)
        for pair in pairs:
            if isinstance(pair, tuple) and pair[0] > pair[1]:
                raise UsageError(
                    f"expected low <= high, found {pair[0]} > {pair[1]} in task.{where}.{name}"
                )


@dataclass(frozen=True)
class CommandConfig:
    """The commands of training episodes; a new one every few seconds."""

    interval: Range = bounded((2.0, 6.0), least=0.02, most=3600)
    """s between changes of velocity and of how hands and height move."""
    standing: float = bounded(0.4, least=0, most=1)
    """Share of commands with zero velocity."""
    forward: tuple[Range, Range] = bounded(((0.1, 0.3), (0.1, 0.8)), least=-3, most=3)
    """m/s, easy and hard."""
    backward: float = bounded(0.15, least=0, most=1)
    """Share of the walking commands that go backwards."""
    backward_speed: tuple[Range, Range] = bounded(((0.1, 0.15), (0.1, 0.35)), least=0, most=3)
    """m/s of those, easy and hard."""
    in_place: float = bounded(0.25, least=0, most=1)
    """Share of the walking commands that go neither forwards nor backwards, only sideways or
    turning."""
    sideways: float = bounded(0.25, least=0, most=3)
    """m/s at the hardest, either way, in a third of the other walking commands."""
    turning: float = bounded(0.7, least=0, most=5)
    """rad/s at the hardest, either way, in a third of the other walking commands."""
    standing_height: tuple[Range, Range] = bounded(((0.65, 0.75), (0.50, 0.76)), least=0.3, most=1)
    """m, easy and hard."""
    walking_height: tuple[Range, Range] = bounded(((0.70, 0.75), (0.55, 0.75)), least=0.3, most=1)
    """m, easy and hard."""
    acceleration: float = bounded(0.8, least=0.01, most=100)
    """m/s^2 and rad/s^2 at which the commanded velocity changes."""
    still_hands: float = bounded(0.2, least=0, most=1)
    """Share of commands whose hands rest; the others follow a random walk."""
    held_hands: float = bounded(0.4, least=0, most=1)
    """Share of those random walks that hold each target for 5 to 15 planner steps; the others
    change at every planner step, as in the paper."""

    def __post_init__(self) -> None:
        check_bounds(self)
        _check_ranges("commands", self)


@dataclass(frozen=True)
class DisturbanceConfig:
    """Pushes, physical parameters, delay and noise."""

    push_interval: Range = bounded((3.0, 8.0), least=0.02, most=3600)
    """s between pushes."""
    push: Range = bounded((0.1, 0.8), least=0, most=5)
    """m/s of horizontal velocity at most, easy and hard."""
    friction: Range = bounded((0.5, 1.1), least=0.01, most=5)
    """Sliding friction of the feet; the simulation diverges without any."""
    payload: Range = bounded((-0.5, 2.0), least=-2, most=30)
    """kg on the torso."""
    mass_scale: Range = bounded((0.95, 1.05), least=0.5, most=2)
    """Factor on every mass."""
    stiffness_scale: Range = bounded((0.8, 1.2), least=0.1, most=5)
    """Factor on the stiffness of every servo."""
    damping_scale: Range = bounded((0.8, 1.2), least=0.1, most=5)
    """Factor on the damping of every servo."""
    delay: Range = bounded((0.0, 0.02), least=0, most=0.04)
    """s from a measurement to the new targets' effect, in physics steps."""
    models: int = bounded(64, least=1, most=4096)
    """Robots of different physical parameters."""

    def __post_init__(self) -> None:
        check_bounds(self)
        _check_ranges("disturbances", self)


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward terms, per second; see `rewards`."""

    alive: float = 0.5
    velocity: float = 3.0
    turning: float = 1.0
    height: float = 1.0
    upright: float = 1.0
    contact: float = 1.0
    stepping: float = -1.0
    torso_rate: float = -0.6
    torso_change: float = -0.2
    slip: float = -0.5
    stance_width: float = -5.0
    foot_heading: float = -1.0
    action: float = -0.02
    action_rate: float = -0.02
    torque: float = -1.0
    fall: float = -100.0


@dataclass(frozen=True)
class LowLevelTask:
    """Commands, disturbances and rewards."""

    commands: CommandConfig = field(default_factory=CommandConfig)
    """What is commanded."""
    disturbances: DisturbanceConfig = field(default_factory=DisturbanceConfig)
    """What disturbs."""
    rewards: RewardConfig = field(default_factory=RewardConfig)
    """What is rewarded."""
    episode: float = bounded(20.0, above=0)
    """s after which an episode is cut."""
