"""Episodes made of random numbers that keep every rule of a dataset."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data.episode import Episode


def random_episode(
    number: int, length: int = 12, time_limit: int | None = None, task: str = "ball", seed: int = 0
) -> Episode:
    """A valid episode: noise whose commands line up with its actions.

    It falls if ``length`` is less than ``time_limit``, which is ``length`` if not given.
    """
    rng = np.random.default_rng((seed, number))
    limit = time_limit or length
    last = np.arange(length) == length - 1
    pixels = (length, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    depth = rng.integers(280, 5000, pixels).astype(np.uint16)
    depth[rng.random(pixels) < 0.1] = 0
    action = rng.uniform(-1, 1, (length, spec.ACTION_DIM)).astype(np.float32)
    return Episode(
        depth=depth,
        state=_state(rng, action),
        action=action,
        reward=rng.normal(size=length).astype(np.float32),
        done=last,
        success=rng.random(length) < 0.1,
        truncated=last & (length == limit),
        task=task,
        time_limit=limit,
        metadata={"seed": seed, "episode": number, "ball": {"radius": 0.1}},
    )


def _state(rng: np.random.Generator, action: NDArray[np.float32]) -> NDArray[np.float32]:
    """(T, 74) proprioception whose command is the action before."""
    state = rng.normal(size=(len(action), spec.STATE_DIM)).astype(np.float32)
    before = np.vstack([np.zeros((1, spec.ACTION_DIM)), action[:-1]])
    hands, height = spec.STATE_SLICES["command_hands"], spec.STATE_SLICES["command_height"]
    state[:, hands.start : height.stop] = spec.ACTION_BOX.to_metric(before)
    return state
