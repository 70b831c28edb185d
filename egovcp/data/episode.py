"""One episode as arrays, and its validation."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.errors import DataError
from egovcp.robot_spec import G1, RobotSpec

_SUM_SLACK = 1e-5  # float32 rounding of the sum of the reward terms
_ACTION_SLACK = 1e-6  # float32 rounding of an action on the boundary of its box

#: Longest episode, frames (33 minutes), because an episode is read as a whole.
EPISODE_FRAMES: Final = 50_000
#: Largest column of a row group, uncompressed. A row group holds one episode.
COLUMN_BYTES: Final = 1 << 30
_IMAGE_BYTES: Final = 128  # of a depth image besides its pixels: TIFF header, length, page headers

type FrameLayout = tuple[tuple[int, ...], type[np.generic]]


@cache
def frame_layout(robot: RobotSpec) -> Mapping[str, FrameLayout]:
    """Array of an episode -> shape and dtype of a frame, in the order of the digest."""
    return {
        "depth": (robot.depth, np.uint16),
        "state": ((robot.state_dim,), np.float32),
        "action": ((robot.action_dim,), np.float32),
        "reward": ((), np.float32),
        "done": ((), np.bool_),
        "success": ((), np.bool_),
        "truncated": ((), np.bool_),
        "reward_terms": ((len(spec.REWARD_TERMS),), np.float32),
        "object": ((spec.OBJECT_DIM,), np.float32),
    }


def frame_bytes(robot: RobotSpec) -> int:
    """Bytes of the arrays of a frame."""
    layout = frame_layout(robot).values()
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in layout)


#: Frame layout of the G1.
FRAME_LAYOUT: Final = frame_layout(G1)
_OPTIONAL: Final = ("reward_terms", "object")
_NOT_GIVEN: Final = np.empty((0, 0), np.float32)


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
    """Name of the task; it need not be installed."""
    time_limit: int
    """Planned length in planner ticks: T, unless a termination came first."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """JSON-compatible facts: scenario seed and episode number, physics parameters."""
    reward_terms: NDArray[np.float32] = field(default_factory=lambda: _NOT_GIVEN)
    """(T, 6) the terms ``spec.REWARD_TERMS``, whose sum is the reward; zeros if not recorded."""
    object: NDArray[np.float32] = field(default_factory=lambda: _NOT_GIVEN)
    """(T, 4) position of the task's object, m, heading frame, at the time of the observation, and
    whether it is known; zeros if not recorded."""
    robot: RobotSpec = G1
    """The robot; the shapes above are the G1's."""

    def __post_init__(self) -> None:
        for name in _OPTIONAL:
            if getattr(self, name) is _NOT_GIVEN:
                shape, dtype = FRAME_LAYOUT[name]  # equal for all robots
                object.__setattr__(self, name, np.zeros((len(self.reward), *shape), dtype))

    def __len__(self) -> int:
        return len(self.reward)

    @property
    def terminated(self) -> bool:
        """The episode ended in failure (a fall), not because of the time limit."""
        return bool(self.done[-1] and not self.truncated[-1])

    def digest(self) -> str:
        """Hexadecimal SHA-256 of the arrays' little-endian bytes, independent of the storage.

        Optional arrays count only if they are recorded.
        """
        out = hashlib.sha256()
        for name in FRAME_LAYOUT:
            array = np.ascontiguousarray(getattr(self, name))
            if name in _OPTIONAL and not array.any():
                continue
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
    if not episode.task:
        yield None, "no task, expected its name"
    length = len(episode.reward)
    if length == 0:
        yield None, "no frames, expected at least one"
    if length > EPISODE_FRAMES:
        yield None, f"{length} frames, expected at most {EPISODE_FRAMES}"
    rows, cols = episode.robot.depth
    most = COLUMN_BYTES // (_IMAGE_BYTES + 2 * rows * cols)
    if length > most:
        yield None, f"{length} frames, expected at most {most} with depth images of {rows}x{cols}"
    for name, (frame, dtype) in frame_layout(episode.robot).items():
        array, shape = getattr(episode, name), (length, *frame)
        if array.shape != shape or array.dtype != dtype:
            found, expected = f"{array.dtype} {array.shape}", f"{np.dtype(dtype)} {shape}"
            yield None, f"{name} is {found}, expected {expected}"


def _value_problems(episode: Episode) -> Iterator[tuple[int, str]]:
    for name in ("state", "action", "reward", *_OPTIONAL):
        finite = np.isfinite(getattr(episode, name)).reshape(len(episode), -1).all(axis=1)
        yield from _where_not(finite, f"{name} is not finite")
    total = episode.reward_terms.sum(1, dtype=np.float64)
    differs = np.abs(total - episode.reward) > _SUM_SLACK * (1 + np.abs(episode.reward))
    if episode.reward_terms.any():
        yield from _where_not(~differs, "reward differs from the sum of reward_terms")
    inside = ~(np.abs(episode.action).max(axis=1) > 1 + _ACTION_SLACK)  # NaN is reported above
    yield from _where_not(inside, "action lies outside [-1, 1]")
    farthest = round(episode.robot.depth_max_m * 1000)
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
