"""One episode as arrays, and what makes it valid."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.errors import DataError, suggest

_ACTION_SLACK = 1e-6  # float32 rounding of an action on the wall of its box

#: The arrays of an episode, in the order in which its digest takes them.
ARRAYS: Final = ("depth", "state", "action", "reward", "done", "success", "truncated")


@dataclass(frozen=True)
class Episode:
    """Rows t = 0..T-1 of (o_t, a_t, r_t after a_t, flags after a_t).

    The observation that follows the last action is not stored (LeRobot's convention).
    """

    depth: NDArray[np.uint16]
    """(T, 48, 64) planar depth, mm; 0 is invalid."""
    state: NDArray[np.float32]
    """(T, 74) proprioception in the layout of ``spec.STATE_SLICES``."""
    action: NDArray[np.float32]
    """(T, 7) action sent, normalised to [-1, 1]."""
    reward: NDArray[np.float32]
    """(T,) reward after the action."""
    done: NDArray[np.bool_]
    """(T,) the episode ended with this row, by termination or by truncation."""
    success: NDArray[np.bool_]
    """(T,) the task's success after the action; never ends an episode."""
    truncated: NDArray[np.bool_]
    """(T,) the episode ended with this row because its time was up."""
    task: str
    """One of ``spec.TASKS``."""
    time_limit: int
    """Planned length in planner ticks: T, unless a termination came first."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """JSON-compatible facts: scenario seed and episode number, physics parameters."""

    def __len__(self) -> int:
        return len(self.reward)

    @property
    def terminated(self) -> bool:
        """The episode ended in failure (a fall), not because its time was up."""
        return bool(self.done[-1] and not self.truncated[-1])

    def digest(self) -> str:
        """SHA-256 of the arrays' little-endian bytes, hexadecimal: the same wherever and by
        whatever tool the episode is stored."""
        out = hashlib.sha256()
        for name in ARRAYS:
            array = np.ascontiguousarray(getattr(self, name))
            out.update(array.astype(array.dtype.newbyteorder("<"), copy=False).data)
        return out.hexdigest()

    def validate(self, where: str = "episode") -> None:
        """Raise `DataError` saying what is wrong, and at which frame of ``where``."""
        _check_layout(self, where)
        _check_values(self, where)
        _check_ending(self, where)


def _check_layout(episode: Episode, where: str) -> None:
    if episode.task not in spec.TASKS:
        hint = suggest(episode.task, spec.TASKS)
        raise DataError(f"{where}: unknown task {episode.task!r}{hint}")
    length = len(episode.reward)
    if length == 0:
        raise DataError(f"{where}: no frames, expected at least one")
    layout: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
        "depth": ((length, spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16),
        "state": ((length, spec.STATE_DIM), np.float32),
        "action": ((length, spec.ACTION_DIM), np.float32),
        "reward": ((length,), np.float32),
        "done": ((length,), np.bool_),
        "success": ((length,), np.bool_),
        "truncated": ((length,), np.bool_),
    }
    for name, (shape, dtype) in layout.items():
        array = getattr(episode, name)
        if array.shape != shape or array.dtype != dtype:
            raise DataError(
                f"{where}: {name} is {array.dtype} {array.shape}, "
                f"expected {np.dtype(dtype)} {shape}"
            )


def _check_values(episode: Episode, where: str) -> None:
    for name in ("state", "action", "reward"):
        finite = np.isfinite(getattr(episode, name)).reshape(len(episode), -1).all(axis=1)
        _require(finite, where, f"{name} is not finite")
    largest = np.abs(episode.action).max(axis=1)
    _require(largest <= 1 + _ACTION_SLACK, where, "action lies outside [-1, 1]")
    farthest = round(spec.DEPTH_MAX_M * 1000)
    deepest = episode.depth.reshape(len(episode), -1).max(axis=1)
    _require(
        np.less_equal(deepest, farthest),
        where,
        f"depth exceeds the camera's range of {farthest} mm",
    )


def _check_ending(episode: Episode, where: str) -> None:
    last = np.arange(len(episode)) == len(episode) - 1
    _require(episode.done == last, where, "done must be set at the last frame, and only there")
    _require(~episode.truncated | last, where, "truncated before the last frame")
    length, limit = len(episode), episode.time_limit
    if length > limit or (episode.truncated[-1] and length != limit):
        raise DataError(
            f"{where}: {length} frames, truncated={bool(episode.truncated[-1])}, "
            f"do not fit its time limit of {limit} ticks"
        )


def _require(ok: NDArray[np.bool_], where: str, problem: str) -> None:
    if not ok.all():
        raise DataError(f"{where}, frame {int(np.argmin(ok))}: {problem}")
