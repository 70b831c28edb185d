"""Records what robots side by side do, each in an episode of its own."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import Episode
from egovcp.sim.env import Observation, StepResult
from egovcp.sim.instance import EnvInstance
from egovcp.sim.scene import HANDS

#: The arrays that a record and an `Episode` share: shape and type per tick.
_ROWS: Final[dict[str, tuple[tuple[int, ...], type[np.generic]]]] = {
    "depth": ((spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16),
    "state": ((spec.STATE_DIM,), np.float32),
    "action": ((spec.ACTION_DIM,), np.float32),
    "reward": ((), np.float32),
    "done": ((), np.bool_),
    "success": ((), np.bool_),
    "truncated": ((), np.bool_),
}


class Record:
    """Arrays (B, T, ...) that fill tick by tick, every row at its own pace."""

    def __init__(self, rows: int, ticks: int) -> None:
        """Room for ``rows`` episodes of at most ``ticks``."""
        self._arrays: dict[str, NDArray[Any]] = {
            name: np.zeros((rows, ticks, *shape), dtype=dtype)
            for name, (shape, dtype) in _ROWS.items()
        }
        self._length = np.zeros(rows, dtype=np.int64)
        self._sums: dict[str, NDArray[np.float64]] = {}
        self._ticks: dict[str, NDArray[np.int64]] = {}
        self._contacts = np.zeros((rows, 2), dtype=np.int64)

    def restart(self, rows: NDArray[np.intp]) -> None:
        """``rows`` have begun new episodes."""
        self._length[rows] = 0
        self._contacts[rows] = 0
        for counts in (*self._sums.values(), *self._ticks.values()):
            counts[rows] = 0

    def add(self, before: Observation, result: StepResult, live: NDArray[np.bool_]) -> None:
        """Store the observation that was acted on, the action sent, and what it brought."""
        rows = np.flatnonzero(live)
        values: dict[str, NDArray[Any]] = {
            "depth": before.depth,
            "state": before.state,
            "action": result.sent_action,
            "reward": result.reward,
            "done": result.terminated | result.truncated,
            "success": result.success,
            "truncated": result.truncated,
        }
        for name, value in values.items():
            self._arrays[name][rows, self._length[rows]] = value[rows]
        self._length[rows] += 1
        for name, term in result.reward_terms.items():
            self._sums.setdefault(name, np.zeros(len(live)))[rows] += term[rows]
            acted = self._ticks.setdefault(name, np.zeros(len(live), dtype=np.int64))
            acted[rows] += term[rows] != 0

    def touch(self, row: int, instance: EnvInstance) -> None:
        """Count the contacts of a row's last tick."""
        touched = instance.task.forces > 0
        hands = touched[list(HANDS)].any()
        self._contacts[row] += hands, touched.sum() > touched[list(HANDS)].sum()

    def episode(self, row: int, instance: EnvInstance) -> Episode:
        """The finished episode of a row."""
        length = int(self._length[row])
        return Episode(
            **{name: array[row, :length].copy() for name, array in self._arrays.items()},
            task=instance.scenario.task,
            time_limit=instance.task.ticks_limit,
            metadata={**_facts(instance), **self._counts(row, instance)},
        )

    def _counts(self, row: int, instance: EnvInstance) -> dict[str, Any]:
        """Sum of each reward term and the ticks in which it was not zero; ticks with contacts."""
        hands, other = self._contacts[row].tolist()
        return {
            "reward_terms": {
                name: {"sum": float(self._sums[name][row]), "ticks": int(self._ticks[name][row])}
                for name in instance.task.terms
            },
            "contact_ticks": {"hands": hands, "other": other},
        }


def _facts(instance: EnvInstance) -> dict[str, Any]:
    return {
        "seed": instance.scenario.seed,
        "episode": instance.scenario.episode,
        "event_tick": instance.task.event_tick,
        "action_delay": instance.action_delay,
        "image_age": instance.image_age,
        "camera_pitch": instance.camera_pitch,
        "physics": asdict(instance.physics),
        "scene": instance.task.parameters,
    }
