"""Skills that a low-level controller is evaluated on: the commands of each tick."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import (
    ACTION_BOX,
    ACTION_DIM,
    ACTION_ETA,
    ACTION_RATE_LIMIT,
    CONTROLLER_HZ,
    CONTROLLER_TICKS_PER_PLAN,
    HELD_TICKS,
    reflect,
)
from egovcp_train.lowlevel.commands import HEIGHT

Array = NDArray[np.float64]
HOLD: Final = 60  # ticks for which a target is held
SETTLED: Final = 30  # ticks after which a held target should be reached
_RAMP: Final = 25  # ticks from standing to the commanded velocity


@dataclass(frozen=True)
class Skill:
    """A skill: one row of the table in docs/lowlevel.md."""

    name: str
    about: str
    seconds: float
    script: Callable[[int, int, np.random.Generator], Array]
    """(ticks, robots, generator) -> commands (ticks, robots, 10)."""
    settled_only: bool = False
    """Measure hands and height only after their target has been held for 0.6 s."""
    push: float = 0.0
    """Sudden change of base velocity after 1 s, m/s."""
    push_any_direction: bool = True
    """Whether the push has a random horizontal direction; else forwards or backwards."""

    @property
    def ticks(self) -> int:
        return round(self.seconds * CONTROLLER_HZ)


def _commands(actions: Array, velocity: Array | None = None) -> Array:
    """Normalised actions (T, N, 7) and velocities (T, N, 3) -> commands (T, N, 10)."""
    still = np.zeros((*actions.shape[:2], 3))
    v = still if velocity is None else velocity
    return np.concatenate([v, ACTION_BOX.to_metric(actions)], axis=-1)


def random_walk(ticks: int, robots: int, rng: np.random.Generator) -> Array:
    """Random walk of collection: a += eta delta each 40 ms, reflected at the box, from neutral."""
    steps = ACTION_ETA * rng.uniform(-1, 1, (ticks // CONTROLLER_TICKS_PER_PLAN, robots, 7))
    walk = reflect(np.cumsum(steps, axis=0))
    return _commands(np.repeat(walk, CONTROLLER_TICKS_PER_PLAN, axis=0))


def held_walk(ticks: int, robots: int, rng: np.random.Generator) -> Array:
    """As `egovcp-collect --eta=1 --step_ticks=[5,15]`: targets held for 5 to 15 planner ticks."""
    target, sent = np.zeros((2, robots, ACTION_DIM))
    ticks_left: NDArray[np.intp] = np.zeros(robots, dtype=np.intp)
    walk = []
    for _ in range(ticks // CONTROLLER_TICKS_PER_PLAN):
        due = ticks_left <= 0
        drawn = rng.integers(*HELD_TICKS, robots, endpoint=True)
        ticks_left = np.where(due, drawn, ticks_left) - 1
        change = rng.uniform(-1, 1, target.shape)
        target = reflect(target + np.where(due[:, None], change, 0.0))
        sent = sent + np.clip(target - sent, -ACTION_RATE_LIMIT, ACTION_RATE_LIMIT)
        walk.append(sent)
    return _commands(np.repeat(np.array(walk), CONTROLLER_TICKS_PER_PLAN, axis=0))


def held_targets(ticks: int, robots: int, rng: np.random.Generator) -> Array:
    """A new target of hands and height every 1.2 s, anywhere in the box."""
    held = rng.uniform(-1, 1, (-(-ticks // HOLD), robots, ACTION_DIM))
    return _commands(np.repeat(held, HOLD, axis=0)[:ticks])


def squats(ticks: int, robots: int, rng: np.random.Generator) -> Array:
    """A new height between 0.50 and 0.74 m every 1.2 s, hands neutral."""
    heights = np.repeat(rng.uniform(0.50, 0.74, (-(-ticks // HOLD), robots)), HOLD, axis=0)[:ticks]
    return _at_height(heights)


def _at_height(heights: Array, velocity: Array | None = None) -> Array:
    command = _commands(np.zeros((*heights.shape, ACTION_DIM)), velocity)
    command[..., -1] = heights
    return command


def walking(
    speed: tuple[float, float], height: tuple[float, float], axis: int = 0
) -> Callable[[int, int, np.random.Generator], Array]:
    """One velocity and one height per robot, hands neutral.

    Args:
        speed: range, m/s or rad/s; negative: backwards.
        height: range, m.
        axis: 0 forwards, 1 to either side, 2 turning either way.
    """

    def script(ticks: int, robots: int, rng: np.random.Generator) -> Array:
        ramp = np.minimum(1.0, np.arange(ticks) / _RAMP)[:, None]
        velocity = np.zeros((ticks, robots, 3))
        velocity[..., axis] = ramp * rng.uniform(*speed, robots)
        if axis > 0:
            velocity[..., axis] *= rng.choice([-1.0, 1.0], robots)
        start = ACTION_BOX.neutral[HEIGHT]
        goal = rng.uniform(*height, robots)
        return _at_height(start + ramp * (goal - start), velocity)

    return script


def neutral(ticks: int, robots: int, rng: np.random.Generator) -> Array:
    """Stand still."""
    return _commands(np.zeros((ticks, robots, ACTION_DIM)))


_UPRIGHT: Final = (0.70, 0.74)  # m

SKILLS: Final = (
    Skill("still", "20 s at the neutral pose", 20.0, neutral),
    Skill("stand", "20 s of the paper's random walk of hands and height", 20.0, random_walk),
    Skill("held", "20 s of random targets held for 5 to 15 planner ticks", 20.0, held_walk),
    Skill("reach", "targets held for 1.2 s, judged after 0.6 s", 12.0, held_targets, True),
    Skill("squat", "heights of 0.50 to 0.74 m, judged after 0.6 s", 12.0, squats, True),
    Skill("walk", "10 s at 0.1 to 0.8 m/s, 0.70 to 0.74 m", 10.0, walking((0.1, 0.8), _UPRIGHT)),
    Skill("backward", "10 s at -0.3 m/s, 0.70 to 0.74 m", 10.0, walking((-0.3, -0.3), _UPRIGHT)),
    Skill(
        "sideways",
        "10 s at 0.2 m/s either way, 0.70 to 0.74 m",
        10.0,
        walking((0.2, 0.2), _UPRIGHT, 1),
    ),
    Skill(
        "turning",
        "10 s at 0.6 rad/s either way, 0.70 to 0.74 m",
        10.0,
        walking((0.6, 0.6), _UPRIGHT, 2),
    ),
    Skill(
        "crouch", "10 s at 0.2 to 0.4 m/s, 0.58 to 0.62 m", 10.0, walking((0.2, 0.4), (0.58, 0.62))
    ),
    Skill("low", "10 s at 0.2 to 0.4 m/s, 0.55 m", 10.0, walking((0.2, 0.4), (0.55, 0.55))),
    Skill(
        "push", "a sudden change of base velocity of 0.5 m/s while standing", 6.0, neutral, push=0.5
    ),
    Skill(
        "hard_push",
        "a sudden change of base velocity of 0.8 m/s forwards or backwards while standing",
        6.0,
        neutral,
        push=0.8,
        push_any_direction=False,
    ),
    Skill("rest", "60 s at the neutral pose", 60.0, neutral),
)
