"""From the picture of a real depth camera to the one the policy knows: crop, resample, clip.

Pixel (i, j) of the small picture looks along ((j - 31.5) / f, (i - 23.5) / f, 1), right, down and
forward, with f = 24 / tan(fov / 2), as the simulated camera does; the great picture is looked up
where its own intrinsics see that ray. Depth is planar in both. Each pixel is the lower median of
the valid ones among nine near its ray, so always a depth that was measured: two surfaces, or a
surface and a hole, are never blended. With fewer than five valid ones it is a hole.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.geometry import focal_length
from egovcp.spec import DEPTH_COLS, DEPTH_MAX_M, DEPTH_MIN_M, DEPTH_ROWS

_NEAREST: Final = math.ceil(DEPTH_MIN_M * 1000)  # mm
_FARTHEST: Final = math.floor(DEPTH_MAX_M * 1000)
_HOLE: Final = np.uint16(65535)  # sorts behind every depth
_SPREAD: Final = 1 / 3  # of a small pixel, from its ray to the samples beside it
_ENOUGH: Final = 5  # of nine


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion, as the depth of a RealSense D400 is."""

    width: int
    height: int
    fx: float
    """Focal lengths, pixels."""
    fy: float
    cx: float
    """Principal point, pixels; the middle of the first pixel is 0."""
    cy: float


class Resampler:
    """Turns pictures of one camera into small ones.

    Args:
        camera: what the great pictures were taken with.
        vertical_fov: of the small pictures, rad.
    """

    def __init__(self, camera: Intrinsics, vertical_fov: float) -> None:
        focal = focal_length(vertical_fov)
        steps = np.array([-_SPREAD, 0.0, _SPREAD])
        down = (np.arange(DEPTH_ROWS)[:, None] - (DEPTH_ROWS - 1) / 2 + steps) / focal
        right = (np.arange(DEPTH_COLS)[:, None] - (DEPTH_COLS - 1) / 2 + steps) / focal
        rows = np.rint(camera.fy * down + camera.cy).astype(np.intp)  # (48, 3)
        columns = np.rint(camera.fx * right + camera.cx).astype(np.intp)  # (64, 3)
        seen_down = (rows >= 0) & (rows < camera.height)
        seen_right = (columns >= 0) & (columns < camera.width)
        index = rows[:, None, :, None] * camera.width + columns[None, :, None, :]
        seen = seen_down[:, None, :, None] & seen_right[None, :, None, :]
        outside = camera.width * camera.height  # a pixel of its own that is always a hole
        self._index = np.where(seen, index, outside).reshape(-1, 9)  # (3072, 9)
        self._shape = (camera.height, camera.width)
        self._flat = np.full(outside + 1, _HOLE, np.uint16)

    @property
    def coverage(self) -> float:
        """Share of the small picture that the camera sees."""
        return float((self._index < len(self._flat) - 1).mean())

    def __call__(self, depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """(height, width) or (height, width, 1) mm, 0 invalid -> (48, 64) mm, 0 invalid.

        Raises:
            ValueError: the picture has another shape than the camera's.
        """
        if depth.shape[:2] != self._shape or depth.size != self._shape[0] * self._shape[1]:
            raise ValueError(f"a picture of shape {depth.shape}, expected {self._shape}")
        self._flat[:-1] = depth.reshape(-1)
        samples = self._flat[self._index]
        valid = (samples >= _NEAREST) & (samples <= _FARTHEST)
        samples[~valid] = _HOLE
        samples.sort(axis=1)
        count = valid.sum(axis=1)
        median = samples[np.arange(len(samples)), np.maximum(count - 1, 0) // 2]
        small = np.where(count >= _ENOUGH, median, np.uint16(0))
        return np.asarray(small.reshape(DEPTH_ROWS, DEPTH_COLS), np.uint16)
