"""Conversion of LeRobot's observations and training batches to those of egovcp."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.data import DatasetReader, ReturnConfig, is_terminal, mc_return, mc_valid
from egovcp.data.privileged import DIM, mirror_privileged, privileged_features
from egovcp.data.source import read_source
from egovcp.errors import DataError, UsageError
from egovcp.model import Batch
from egovcp.robot_spec import G1
from lerobot_policy_egovcp.configuration_egovcp import FEATURE_SHAPES

_COLUMNS = (
    *(spec.REWARD_KEY, spec.REWARD_TERMS_KEY, spec.DONE_KEY, spec.TRUNCATED_KEY),
    spec.OBJECT_KEY,
)
_CHANNEL_LAST: Final = (spec.DEPTH_ROWS, spec.DEPTH_COLS, 1)
_UNUSABLE: Final = (torch.bool, torch.uint8, torch.int8)  # too small for millimetres
_EXPECTED: Final = {
    spec.DEPTH_KEY: "millimetres as uint16, int32 or float32",
    spec.STATE_KEY: "numbers, such as float32",
}


def read_observation(
    batch: Mapping[str, Any], check_unit: bool = True
) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Depth (E, 48, 64) in mm, 0 = invalid, and state (E, 74) of one step of E robots.

    Args:
        batch: ``observation.images.ego_depth`` (E, 1, 48, 64) or (E, 48, 64, 1), in millimetres
            of any integer or float type but uint8, and ``observation.state`` (E, 74). Without E
            it is the observation of one robot, as `LeRobotDataset` returns it.
        check_unit: see `to_millimetres`.
    """
    depth, state = _part(batch, spec.DEPTH_KEY), _part(batch, spec.STATE_KEY)
    if len(depth) != len(state) or len(state) == 0:
        raise DataError(
            f"{spec.DEPTH_KEY} is of {len(depth)} robots and {spec.STATE_KEY} of {len(state)}; "
            "expected one observation of each of at least one robot"
        )
    return (
        to_millimetres(depth, check_unit).cpu().numpy().astype(np.uint16),
        state.to("cpu", torch.float32).numpy(),
    )


def to_millimetres(depth: Tensor, check_unit: bool = True) -> Tensor:
    """LeRobot's depth (..., 1, 48, 64), millimetres -> (..., 48, 64) whole ones, int32.

    Negative and non-finite values become 0, invalid. Raises `DataError` for another type or shape,
    and under ``check_unit`` if nothing is as far as the camera's nearest distance. That shows
    another unit, or, of a single image, that an object covers the camera: check whole batches of a
    dataset, but of the images seen by a robot only the first of an episode.
    """
    _require_type(spec.DEPTH_KEY, depth)
    if tuple(depth.shape[-3:]) != FEATURE_SHAPES[spec.DEPTH_KEY]:
        raise _wrong_shape(spec.DEPTH_KEY, depth, "(..., {})")
    # torch has no arithmetic for uint16
    finite = depth.squeeze(-3).float().nan_to_num(0.0, 0.0, 0.0)
    farthest = float(finite.max()) if check_unit and finite.numel() else 0.0
    if 0 < farthest < spec.DEPTH_MIN_M * 1e3:
        raise DataError(
            f"{spec.DEPTH_KEY} is at most {farthest:g}, less than the camera's nearest "
            f"{spec.DEPTH_MIN_M * 1e3:g} mm: the policy reads millimetres, not metres"
        )
    return finite.round().clamp(0, torch.iinfo(torch.uint16).max).to(torch.int32)


def _part(batch: Mapping[str, Any], key: str) -> Tensor:
    """The depth (E, 1, 48, 64) or the state (E, 74) of E robots."""
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
    _require_type(key, value)
    if tuple(value.shape[-3:]) == _CHANNEL_LAST:
        value = value.movedim(-1, -3)
    shape = FEATURE_SHAPES[key]
    missing = len(shape) + 1 - value.ndim
    if tuple(value.shape[-len(shape) :]) != shape or missing not in (0, 1):
        raise _wrong_shape(key, value, "(E, {0}) for E robots, or ({0}) for one")
    return value[None] if missing else value


def _require_type(key: str, value: Tensor) -> None:
    if value.dtype in _UNUSABLE:
        name = str(value.dtype).removeprefix("torch.")
        raise DataError(f"{key} has type {name}; expected {_EXPECTED[key]}")


def _wrong_shape(key: str, value: Tensor, expected: str) -> DataError:
    shape = expected.format(", ".join(map(str, FEATURE_SHAPES[key])))
    return DataError(f"{key} has shape {tuple(value.shape)}; expected {shape}")


@dataclass(frozen=True)
class RowTargets:
    """Reward, return and termination of every row of a dataset, by LeRobot's row ``index``.

    They are computed once, from whole columns: LeRobot reads no windows of scalar columns, and a
    return needs rows beyond a window.
    """

    mc_return: Tensor  # (N,)
    mc_valid: Tensor  # (N,) bool
    terminal_next: Tensor  # (N,) bool
    reward: Tensor  # (N,) see `ReturnConfig.target_reward`
    privileged: Tensor  # (N, F) see `egovcp.data.privileged`

    @classmethod
    def of(cls, reader: DatasetReader, config: ReturnConfig) -> Self:
        """The targets of a dataset; raises `DataError` if no return is complete.

        Those of episodes whose file is not there are zeros and not valid: LeRobot downloads only
        the files of ``--dataset.episodes``.
        """
        parts = [_episode_targets(reader, i, config) for i in range(len(reader))]
        found = cls(*(torch.from_numpy(np.concatenate(c)) for c in zip(*parts, strict=True)))
        if not found.mc_valid.any():
            raise DataError(
                f"{reader.root}: no row has a complete Monte Carlo return: the episodes (at most "
                f"{int(reader.lengths.max())} ticks) are not longer than --policy.returns.steps; "
                "lower it, or collect longer episodes"
            )
        return found

    @property
    def usable(self) -> Tensor:
        """The complete returns, (n,)."""
        return self.mc_return[self.mc_valid]

    def window(self, index: Tensor, length: int) -> dict[str, Tensor]:
        """Targets (B, length) of the windows that begin at rows ``index`` (B,).

        Past the dataset's end the last row is repeated.
        """
        rows = index.reshape(-1, 1).cpu() + torch.arange(length)
        rows = rows.clamp_max(len(self.mc_return) - 1)
        return {name: values[rows].to(index.device) for name, values in vars(self).items()}


def _episode_targets(reader: DatasetReader, index: int, config: ReturnConfig) -> tuple[Any, ...]:
    if not reader.data_path(index).exists():
        length = int(reader.lengths[index])
        zeros, never = np.zeros(length, np.float32), np.zeros(length, np.bool_)
        return zeros, never, never, zeros, np.zeros((length, DIM), np.float32)
    columns = reader.read_episode_columns(index, _COLUMNS)
    reward, terms, done, truncated, position = (columns[name] for name in _COLUMNS)
    if not (np.isfinite(reward).all() and np.isfinite(terms).all()):
        raise DataError.at(reader.data_path(index), "a reward is not a number", index)
    reward = config.target_reward(reward, terms)
    limit = reader.time_limit(index)
    return (
        mc_return(reward, config.gamma, config.steps),
        mc_valid(len(reward), limit, config.steps, config.keep_truncated),
        is_terminal(done, truncated),
        reward,
        privileged_features(position, terms),
    )


def open_reader(root: Path, repo_id: str) -> DatasetReader:
    """A reader of the dataset that LeRobot has loaded from ``root``; `UsageError`: of another robot
    than the G1."""
    reader = DatasetReader(read_source(root, repo_id))
    if not reader.robot.is_g1:
        raise UsageError(
            f"{reader.root} is of robot {reader.robot.robot_type}: LeRobot's commands train "
            "policies of the G1; use egovcp-train"
        )
    return reader


def to_batch(batch: Mapping[str, Tensor], targets: RowTargets) -> Batch:
    """Convert a batch of LeRobot's windows to the `Batch` of the losses.

    Args:
        batch: observations (B, T, ...) of rows t .. t + T - 1 and actions (B, T + 1, 7) from
            row t - 1 on, with LeRobot's ``_is_pad`` masks and the ``index`` (B,) of row t.
    """
    state, action = batch[spec.STATE_KEY], batch[spec.ACTION_KEY]
    valid = ~batch[f"{spec.STATE_KEY}_is_pad"]
    is_first = torch.zeros_like(valid)
    is_first[:, 0] = batch[f"{spec.ACTION_KEY}_is_pad"][:, 0]
    rows = targets.window(batch["index"], state.shape[1])
    return Batch(
        depth=to_millimetres(batch[spec.DEPTH_KEY]),
        state=state,
        action=action[:, 1:],
        prev_action=action[:, :-1].masked_fill(is_first[..., None], 0.0),
        is_first=is_first,
        valid=valid,
        mc_return=rows["mc_return"],
        mc_valid=rows["mc_valid"] & valid,
        terminal_next=rows["terminal_next"] & valid,
        reward=rows["reward"],
        privileged=rows["privileged"],
    )


def mirrored(rows: Batch, which: Tensor) -> Batch:
    """The batch with the windows ``which`` (B,) bool mirrored left to right."""

    def swap(value: Tensor, source: Sequence[int], sign: Sequence[float]) -> Tensor:
        other = value[..., list(source)] * torch.tensor(sign).to(value)
        return torch.where(which[:, None, None], other, value)

    robot = G1.mirror
    assert robot is not None, "the G1 is symmetric"
    signs = mirror_privileged(np.ones(rows.privileged.shape[-1], np.float32)).tolist()
    return rows._replace(
        depth=torch.where(which[:, None, None, None], rows.depth.flip(-1), rows.depth),
        privileged=swap(rows.privileged, range(len(signs)), signs),
        state=swap(rows.state, robot.state_source, robot.state_sign),
        action=swap(rows.action, robot.action_source, robot.action_sign),
        prev_action=swap(rows.prev_action, robot.action_source, robot.action_sign),
    )
