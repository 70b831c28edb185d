"""An environment without physics that shows how often it was stepped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egovcp import spec


@dataclass(frozen=True)
class ToyObservation:
    """What `CountingEnv` shows."""

    depth: NDArray[np.uint16]  # (B, 48, 64), mm: 1000 + ticks since the reset
    state: NDArray[np.float32]  # (B, 74): zeros but for the command sent last


@dataclass(frozen=True)
class ToyStep:
    """What a tick of `CountingEnv` brought."""

    observation: ToyObservation
    reward: NDArray[np.float64]
    reward_terms: dict[str, NDArray[np.float64]]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    success: NDArray[np.bool_]
    sent_action: NDArray[np.float64]


class CountingEnv:
    """B robots without a body: the image counts ticks, the state holds the last command.

    A scenario is a whole number, the tick at which the episode is over. The robot falls
    when its commanded height comes within 0.05 of the box's floor.
    """

    def __init__(self, num_envs: int = 2) -> None:
        self.num_envs = num_envs
        self._limit: NDArray[np.int64] = np.zeros(num_envs, dtype=np.int64)
        self._tick = np.zeros(num_envs, dtype=np.int64)
        self._fallen = np.zeros(num_envs, dtype=np.bool_)
        self._sent: NDArray[np.float64] = np.zeros((num_envs, spec.ACTION_DIM))

    def reset(self, scenarios: Sequence[int]) -> ToyObservation:
        """Start an episode in every row."""
        self._limit = np.array(scenarios, dtype=np.int64)
        self._tick[:] = 0
        self._fallen[:] = False
        self._sent = np.zeros((self.num_envs, spec.ACTION_DIM))
        return self._observe()

    def step(self, action: NDArray[np.floating]) -> ToyStep:
        """Limit, send, count; rows that are over stay as they are, with zero reward."""
        live = ~self._fallen & (self._tick < self._limit)
        change = np.clip(
            np.asarray(action, dtype=np.float64) - self._sent,
            -spec.ACTION_RATE_LIMIT,
            spec.ACTION_RATE_LIMIT,
        )
        moved = np.clip(self._sent + change, -1.0, 1.0)
        self._sent = np.where(live[:, None], moved, self._sent)
        self._tick += live
        self._fallen |= live & (self._sent[:, -1] < -0.95)
        reward = np.where(live, -np.square(self._sent).mean(1), 0.0)
        return ToyStep(
            observation=self._observe(),
            reward=reward,
            reward_terms={"effort": reward},
            terminated=self._fallen.copy(),
            truncated=~self._fallen & (self._tick >= self._limit),
            success=np.zeros(self.num_envs, dtype=np.bool_),
            sent_action=self._sent.copy(),
        )

    def _observe(self) -> ToyObservation:
        image = (1000 + self._tick).astype(np.uint16)[:, None, None]
        depth = np.broadcast_to(image, (self.num_envs, spec.DEPTH_ROWS, spec.DEPTH_COLS))
        state = np.zeros((self.num_envs, spec.STATE_DIM), dtype=np.float32)
        state[:, spec.STATE_SLICES["projected_gravity"].stop - 1] = -1.0
        hands, height = spec.STATE_SLICES["command_hands"], spec.STATE_SLICES["command_height"]
        state[:, hands.start : height.stop] = spec.ACTION_BOX.to_metric(self._sent)
        return ToyObservation(depth.copy(), state)
