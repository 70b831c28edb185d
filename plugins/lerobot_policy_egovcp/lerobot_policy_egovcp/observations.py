"""Observations as LeRobot hands them over -> the arrays that `egovcp.plan.Policy` reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.errors import DataError

_IMAGE: Final = (1, spec.DEPTH_ROWS, spec.DEPTH_COLS)
_CHANNEL_LAST: Final = (spec.DEPTH_ROWS, spec.DEPTH_COLS, 1)
_INTEGERS: Final = (torch.uint16, torch.int16, torch.int32, torch.uint32, torch.int64)
_FLOATS: Final = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_SHAPES: Final = {spec.DEPTH_KEY: _IMAGE, spec.STATE_KEY: (spec.STATE_DIM,)}


def read_observation(
    batch: Mapping[str, Any],
) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Depth (E, 48, 64) in mm, 0 = invalid, and state (E, 74) of one step of E robots.

    Args:
        batch: ``observation.images.ego_depth`` (E, 1, 48, 64) or (E, 48, 64, 1), in millimetres
            of any integer or float type but uint8, and ``observation.state`` (E, 74). Without E
            it is the observation of one robot, as `LeRobotDataset` returns it.

    Raises:
        DataError: one is missing, or of another type, shape or unit.
    """
    depth, state = (_tensor(batch, key) for key in (spec.DEPTH_KEY, spec.STATE_KEY))
    if tuple(depth.shape[-3:]) == _CHANNEL_LAST:
        depth = depth.movedim(-1, -3)
    depth, state = _batched(depth, spec.DEPTH_KEY), _batched(state, spec.STATE_KEY)
    if len(depth) != len(state) or len(state) == 0:
        raise DataError(
            f"{spec.DEPTH_KEY} is of {len(depth)} robots and {spec.STATE_KEY} of {len(state)}; "
            "expected one observation of each of at least one robot"
        )
    return (
        to_millimetres(depth).cpu().numpy().astype(np.uint16),
        state.to("cpu", torch.float32).numpy(),
    )


def to_millimetres(depth: Tensor) -> Tensor:
    """LeRobot's depth (..., 1, 48, 64), millimetres -> (..., 48, 64) whole ones, int32.

    What is negative or not finite becomes 0, invalid.

    Raises:
        DataError: another type or shape; or no millimetres.
    """
    if depth.dtype not in (*_INTEGERS, *_FLOATS):
        raise DataError(
            f"{spec.DEPTH_KEY} has type {_name(depth)}; expected millimetres as uint16, int32 or "
            "float32"
        )
    if tuple(depth.shape[-3:]) != _IMAGE:
        raise _wrong_shape(spec.DEPTH_KEY, depth, f"(..., {_spoken(_IMAGE)})")
    # torch has no arithmetic for uint16
    finite = depth.squeeze(-3).float().nan_to_num(0.0, 0.0, 0.0)
    farthest = float(finite.max()) if finite.numel() else 0.0
    if 0 < farthest < spec.DEPTH_MIN_M * 1e3:
        raise DataError(
            f"{spec.DEPTH_KEY} is at most {farthest:g}, less than the camera's nearest "
            f"{spec.DEPTH_MIN_M * 1e3:g} mm: the policy reads millimetres, not metres"
        )
    return finite.round().clamp(0, torch.iinfo(torch.uint16).max).to(torch.int32)


def _tensor(batch: Mapping[str, Any], key: str) -> Tensor:
    if key not in batch:
        given = ", ".join(sorted(name for name in batch if name.startswith("observation")))
        raise DataError(
            f"the observation has no {key!r}, only {given or 'other keys'}; a camera or state of "
            "another name is renamed with --rename_map"
        )
    value = batch[key]
    if not isinstance(value, Tensor):
        raise DataError(
            f"{key} is a {type(value).__name__}; expected a torch.Tensor (torch.from_numpy)"
        )
    if key == spec.STATE_KEY and value.dtype not in (*_INTEGERS, *_FLOATS):
        raise DataError(f"{key} has type {_name(value)}; expected numbers, such as float32")
    return value


def _batched(value: Tensor, key: str) -> Tensor:
    """With the dimension E of the robots."""
    shape = _SHAPES[key]
    missing = len(shape) + 1 - value.ndim
    if tuple(value.shape[-len(shape) :]) != shape or missing not in (0, 1):
        expected = f"(E, {_spoken(shape)}) for E robots, or ({_spoken(shape)}) for one"
        raise _wrong_shape(key, value, expected)
    return value[None] if missing else value


def _wrong_shape(key: str, value: Tensor, expected: str) -> DataError:
    return DataError(f"{key} has shape {tuple(value.shape)}; expected {expected}")


def _spoken(shape: tuple[int, ...]) -> str:
    return ", ".join(map(str, shape))


def _name(value: Tensor) -> str:
    return str(value.dtype).removeprefix("torch.")
