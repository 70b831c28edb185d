"""Commands of training episodes: velocities, heights and hands that move as in collection."""

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
    reflect,
)
from egovcp_train.lowlevel.task import CommandConfig, Range

Array = NDArray[np.float64]
_DT: Final = 1.0 / CONTROLLER_HZ
_HEIGHT: Final = ACTION_DIM - 1
_HELD_ETA: Final = 1.0  # box units, the steps of a random walk that steps seldom
_HELD_TICKS: Final = (5, 15)  # planner ticks between them, inclusive


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
        self._action = np.zeros((robots, ACTION_DIM))  # as the planner would send it
        self._wanted = np.zeros((robots, ACTION_DIM))  # where it is on its way to
        self._held = np.zeros(robots, dtype=bool)  # which step seldom and far
        self._rest: NDArray[np.intp] = np.zeros(
            robots, dtype=np.intp
        )  # planner ticks until their next step
        self._moves = np.zeros((robots, ACTION_DIM), dtype=bool)  # which follow the random walk
        self._low = np.full(robots, -1.0)  # of the height's action
        self._ticks_left = np.zeros(robots, dtype=np.intp)
        self._tick = 0

    @property
    def standing(self) -> NDArray[np.bool_]:
        """(N,) no velocity is wanted."""
        return np.asarray(~self._goal.any(axis=1))

    @property
    def vector(self) -> Array:
        """(N, 10) v, hands, height."""
        return np.concatenate([self.velocity, ACTION_BOX.to_metric(self._action)], axis=1)

    def reset(self, rows: NDArray[np.intp]) -> None:
        """New episodes: standing, neutral, and soon another command."""
        self.velocity[rows] = self._goal[rows] = 0.0
        self._action[rows] = self._wanted[rows] = 0.0
        self._moves[rows] = self._held[rows] = False
        self._rest[rows] = 0
        self._ticks_left[rows] = self._rng.integers(5, 50, len(rows))

    def advance(self) -> None:
        """One tick: new commands where their time is over, hands and height a step on."""
        self._ticks_left -= 1
        rows = np.flatnonzero(self._ticks_left <= 0)
        if len(rows):
            self._draw(rows)
        limit = self._config.acceleration * _DT
        self.velocity += np.clip(self._goal - self.velocity, -limit, limit)
        self._tick += 1
        if self._tick % CONTROLLER_TICKS_PER_PLAN == 0:
            self._walk_randomly()

    def _walk_randomly(self) -> None:
        steps = ~self._held | (self._rest <= 0)
        size = np.where(self._held, _HELD_ETA, ACTION_ETA) * steps
        drawn = self._rng.integers(*_HELD_TICKS, len(steps), endpoint=True)
        self._rest = np.where(self._held & steps, drawn, self._rest) - 1
        step = size[:, None] * self._rng.uniform(-1, 1, self._action.shape)
        low = np.full(step.shape, -1.0)
        low[:, _HEIGHT] = self._low
        self._wanted[:] = reflect(self._wanted + np.where(self._moves, step, 0.0), low)
        limit = ACTION_RATE_LIMIT
        self._action += np.clip(self._wanted - self._action, -limit, limit)

    def _draw(self, rows: NDArray[np.intp]) -> None:
        config, rng, n = self._config, self._rng, len(rows)
        low, high = config.interval
        self._ticks_left[rows] = (rng.uniform(low, high, n) * CONTROLLER_HZ).astype(np.intp)
        walks = rng.random(n) > config.standing
        self._goal[rows] = np.where(walks[:, None], self._velocities(n), 0.0)
        self._moves[rows] = (rng.random(n) > config.still_hands)[:, None]
        self._held[rows] = rng.random(n) < config.held_hands
        self._wanted[rows] = self._action[rows]
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
        """Half of the standing robots squat at random, the rest go to a height and keep it."""
        metric = np.tile(np.asarray(ACTION_BOX.neutral), (len(rows), 1))
        metric[:, _HEIGHT] = height
        wanted = np.clip(ACTION_BOX.to_normalised(metric)[:, _HEIGHT], -1.0, 1.0)
        squats = ~walks & (self._rng.random(len(rows)) < 0.5)
        lowest = between(*self._config.standing_height, self.difficulty)[0]
        metric[:, _HEIGHT] = lowest
        bound = np.clip(ACTION_BOX.to_normalised(metric)[:, _HEIGHT], -1.0, 1.0)
        self._moves[rows, _HEIGHT] = squats
        self._low[rows] = np.where(squats, bound, -1.0)
        kept = self._action[rows, _HEIGHT]
        self._action[rows, _HEIGHT] = self._wanted[rows, _HEIGHT] = np.where(squats, kept, wanted)
