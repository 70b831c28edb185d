"""Commands and pushes of training episodes: velocities, heights, and hands as in collection."""

from __future__ import annotations

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
    HELD_ETA,
    HELD_TICKS,
    reflect,
)
from egovcp_train.lowlevel.config import CommandConfig, DisturbanceConfig, Range

Array = NDArray[np.float64]
HEIGHT: Final = ACTION_DIM - 1
"""Index of the pelvis height in an action."""


def between(easy: Range, hard: Range, difficulty: float) -> Range:
    """The range at ``difficulty`` in [0, 1]."""
    low, high = (e + difficulty * (h - e) for e, h in zip(easy, hard, strict=True))
    return low, high


class Commands:
    """Commands of N robots, advanced tick by tick."""

    def __init__(self, robots: int, config: CommandConfig, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        self.difficulty = 0.0
        self.velocity = np.zeros((robots, 3))  # m/s, m/s, rad/s, ramped
        self._goal = np.zeros((robots, 3))
        # Sent to the controller; it moves at the rate limit, but the height of a new command jumps.
        self._action = np.zeros((robots, ACTION_DIM))
        self._target = np.zeros((robots, ACTION_DIM))  # towards which the action moves
        self._is_random = np.zeros((robots, ACTION_DIM), dtype=bool)  # follows a random walk
        self._holds_targets = np.zeros(robots, dtype=bool)  # if random, for some planner ticks
        self._hold_ticks_left: NDArray[np.intp] = np.zeros(robots, dtype=np.intp)
        self._low = np.full(robots, -1.0)  # lower bound of the height's action
        self._ticks_left = np.zeros(robots, dtype=np.intp)
        self._tick = 0

    @property
    def vector(self) -> Array:
        """(N, 10) v, hands, height."""
        return np.concatenate([self.velocity, ACTION_BOX.to_metric(self._action)], axis=1)

    @property
    def standing(self) -> NDArray[np.bool_]:
        """(N,) robots with zero velocity, commanded and wanted."""
        return np.asarray(~(self.velocity.any(axis=1) | self._goal.any(axis=1)))

    def keep_commands(self, rows: NDArray[np.intp], seconds: Array) -> None:
        """Draw no other commands for so many seconds (n,)."""
        self._ticks_left[rows] = (seconds * CONTROLLER_HZ).astype(np.intp) + 1

    def move_hands(self, rows: NDArray[np.intp], target: Array) -> None:
        """Move hands to ``target`` (n, 6), normalised, at the rate limit, and end their random
        walk until the next command."""
        self._is_random[rows, :HEIGHT] = False
        self._target[rows, :HEIGHT] = target

    def reset(self, rows: NDArray[np.intp]) -> None:
        """New episodes: standing and neutral, with another command within a second."""
        self.velocity[rows] = self._goal[rows] = 0.0
        self._action[rows] = self._target[rows] = 0.0
        self._is_random[rows] = self._holds_targets[rows] = False
        self._hold_ticks_left[rows] = 0
        self._ticks_left[rows] = self._rng.integers(5, 50, len(rows))

    def advance(self) -> None:
        """One tick: draws the commands that are due, ramps velocities, moves hands and height."""
        self._ticks_left -= 1
        rows = np.flatnonzero(self._ticks_left <= 0)
        if len(rows):
            self._draw(rows)
        limit = self._config.acceleration / CONTROLLER_HZ
        self.velocity += np.clip(self._goal - self.velocity, -limit, limit)
        self._tick += 1
        if self._tick % CONTROLLER_TICKS_PER_PLAN == 0:
            self._walk_randomly()

    def _walk_randomly(self) -> None:
        holds, left = self._holds_targets, self._hold_ticks_left
        steps = ~holds | (left <= 0)
        size = np.where(holds, HELD_ETA, ACTION_ETA) * steps
        drawn = self._rng.integers(*HELD_TICKS, len(steps), endpoint=True)
        self._hold_ticks_left = np.where(holds & steps, drawn, left) - 1
        step = size[:, None] * self._rng.uniform(-1, 1, self._action.shape)
        low = np.full(step.shape, -1.0)
        low[:, HEIGHT] = self._low
        self._target[:] = reflect(self._target + np.where(self._is_random, step, 0.0), low)
        limit = ACTION_RATE_LIMIT
        self._action += np.clip(self._target - self._action, -limit, limit)

    def _draw(self, rows: NDArray[np.intp]) -> None:
        config, rng, n = self._config, self._rng, len(rows)
        low, high = config.interval
        self._ticks_left[rows] = (rng.uniform(low, high, n) * CONTROLLER_HZ).astype(np.intp)
        walks = rng.random(n) > config.standing
        self._goal[rows] = np.where(walks[:, None], self._velocities(n), 0.0)
        self._is_random[rows] = (rng.random(n) > config.still_hands)[:, None]
        self._holds_targets[rows] = rng.random(n) < config.held_hands
        self._target[rows] = self._action[rows]
        heights = np.where(
            walks,
            rng.uniform(*between(*config.walking_height, self.difficulty), n),
            rng.uniform(*between(*config.standing_height, self.difficulty), n),
        )
        self._set_height(rows, heights, walks)

    def _velocities(self, n: int) -> Array:
        config, rng = self._config, self._rng
        out = np.zeros((n, 3))
        out[:, 0] = rng.uniform(*between(*config.forward, self.difficulty), n)
        back = rng.uniform(*between(*config.backward_speed, self.difficulty), n)
        out[:, 0] = np.where(rng.random(n) < config.backward, -back, out[:, 0])
        in_place = rng.random(n) < config.in_place
        out[in_place, 0] = 0.0
        turns = rng.random(n) < 0.5  # of those in place
        for axis, most in ((1, config.sideways), (2, config.turning)):
            value = self.difficulty * most * rng.uniform(-1, 1, n)
            chosen = np.where(in_place, turns == (axis == 2), rng.random(n) < 1 / 3)
            out[:, axis] = np.where(chosen, value, 0.0)
        return out

    def _set_height(self, rows: NDArray[np.intp], height: Array, walks: NDArray[np.bool_]) -> None:
        """Half of the standing robots squat at random; the others get one height, at once."""
        target = _height_action(height)
        squats = ~walks & (self._rng.random(len(rows)) < 0.5)
        lowest = between(*self._config.standing_height, self.difficulty)[0]
        bound = _height_action(np.full(len(rows), lowest))
        self._is_random[rows, HEIGHT] = squats
        self._low[rows] = np.where(squats, bound, -1.0)
        kept = self._action[rows, HEIGHT]
        self._action[rows, HEIGHT] = self._target[rows, HEIGHT] = np.where(squats, kept, target)


def _height_action(height: Array) -> Array:
    """(N,) m -> (N,) in [-1, 1]."""
    metric = np.tile(np.asarray(ACTION_BOX.neutral), (len(height), 1))
    metric[:, HEIGHT] = height
    return np.clip(ACTION_BOX.to_normalised(metric)[:, HEIGHT], -1.0, 1.0)


def random_push(
    n: int, config: DisturbanceConfig, difficulty: float, rng: np.random.Generator
) -> Array:
    """(n, 2) m/s to add to the pelvis's horizontal velocity, any direction."""
    low, high = config.push
    most = low + difficulty * (high - low)
    angle = rng.uniform(-np.pi, np.pi, n)
    return horizontal(rng.uniform(0.0, most, n), angle)


def horizontal(speed: Array | float, angle: Array) -> Array:
    """(n, 2) m/s of that speed in the directions ``angle`` (n,)."""
    return np.stack([speed * np.cos(angle), speed * np.sin(angle)], axis=1)
