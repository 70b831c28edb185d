"""One episode as arrays, and its validation."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.errors import DataError, suggest

_ACTION_SLACK = 1e-6  # float32 rounding of an action on the boundary of its box

#: Longest episode, frames (33 minutes), because an episode is read as a whole.
EPISODE_FRAMES: Final = 50_000

type FrameLayout = tuple[tuple[int, ...], type[np.generic]]

#: Array of an episode -> shape and dtype of a frame, in the order of the digest.
FRAME_LAYOUT: Final[Mapping[str, FrameLayout]] = {
    "depth": ((spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16),
    "state": ((spec.STATE_DIM,), np.float32),
    "action": ((spec.ACTION_DIM,), np.float32),
    "reward": ((), np.float32),
    "done": ((), np.bool_),
    "success": ((), np.bool_),
    "truncated": ((), np.bool_),
}


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
    """(T,) the episode ended with this row because of the time limit."""
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
        """The episode ended in failure (a fall), not because of the time limit."""
        return bool(self.done[-1] and not self.truncated[-1])

    def digest(self) -> str:
        """Hexadecimal SHA-256 of the arrays' little-endian bytes, independent of the storage."""
        out = hashlib.sha256()
        for name in FRAME_LAYOUT:
            array = np.ascontiguousarray(getattr(self, name))
            out.update(array.astype(array.dtype.newbyteorder("<"), copy=False).data)
        return out.hexdigest()

    def validate(self, where: str = "episode") -> None:
        """Raise `DataError` with the first problem; ``where`` names the episode."""
        for frame, problem in self.problems():
            place = where if frame is None else f"{where}, frame {frame}"
            raise DataError(f"{place}: {problem}")

    def problems(self) -> Iterator[tuple[int | None, str]]:
        """All problems: (first frame at fault, or None; the problem)."""
        layout = list(_layout_problems(self))
        yield from layout
        if not layout:
            yield from _value_problems(self)
            yield from _ending_problems(self)


def _layout_problems(episode: Episode) -> Iterator[tuple[int | None, str]]:
    if episode.task not in spec.TASKS:
        yield None, f"unknown task {episode.task!r}{suggest(episode.task, spec.TASKS)}"
    length = len(episode.reward)
    if length == 0:
        yield None, "no frames, expected at least one"
    if length > EPISODE_FRAMES:
        yield None, f"{length} frames, expected at most {EPISODE_FRAMES}"
    for name, (frame, dtype) in FRAME_LAYOUT.items():
        array, shape = getattr(episode, name), (length, *frame)
        if array.shape != shape or array.dtype != dtype:
            found, expected = f"{array.dtype} {array.shape}", f"{np.dtype(dtype)} {shape}"
            yield None, f"{name} is {found}, expected {expected}"


def _value_problems(episode: Episode) -> Iterator[tuple[int, str]]:
    for name in ("state", "action", "reward"):
        finite = np.isfinite(getattr(episode, name)).reshape(len(episode), -1).all(axis=1)
        yield from _where_not(finite, f"{name} is not finite")
    inside = ~(np.abs(episode.action).max(axis=1) > 1 + _ACTION_SLACK)  # NaN is reported above
    yield from _where_not(inside, "action lies outside [-1, 1]")
    farthest = round(spec.DEPTH_MAX_M * 1000)
    deepest = episode.depth.reshape(len(episode), -1).max(axis=1)
    near = np.less_equal(deepest, farthest)
    yield from _where_not(near, f"depth exceeds the camera's range of {farthest} mm")


def _ending_problems(episode: Episode) -> Iterator[tuple[int | None, str]]:
    last = np.arange(len(episode)) == len(episode) - 1
    once = "done must be set at the last frame, and only there"
    yield from _where_not(episode.done == last, once)
    yield from _where_not(~episode.truncated | last, "truncated before the last frame")
    length, limit = len(episode), episode.time_limit
    if length > limit or (episode.truncated[-1] and length != limit):
        yield (
            None,
            f"{length} frames, truncated={bool(episode.truncated[-1])}, do not fit its time limit "
            f"of {limit} ticks",
        )


def _where_not(ok: NDArray[np.bool_], problem: str) -> Iterator[tuple[int, str]]:
    if not ok.all():
        yield int(np.argmin(ok)), problem
