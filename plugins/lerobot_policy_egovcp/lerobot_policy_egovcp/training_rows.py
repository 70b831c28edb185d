"""What the losses need of a LeRobot batch and of the dataset's rewards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.data import DatasetReader, ReturnConfig, is_terminal, mc_return, mc_valid, mirror
from egovcp.data.source import recorded
from egovcp.errors import DataError
from egovcp.model import Batch
from lerobot_policy_egovcp.observations import to_millimetres

_COLUMNS = (spec.REWARD_KEY, spec.DONE_KEY, spec.TRUNCATED_KEY)


@dataclass(frozen=True)
class Targets:
    """Reward, return and termination of every row of a dataset, by LeRobot's row ``index``.

    LeRobot reads no windows of scalar columns, and a return reaches farther than a window;
    so the targets are computed once, from the whole columns of reward and done.
    """

    mc_return: Tensor  # (N,)
    mc_valid: Tensor  # (N,) bool
    terminal_next: Tensor  # (N,) bool
    reward: Tensor  # (N,)

    @classmethod
    def of(cls, reader: DatasetReader, config: ReturnConfig) -> Self:
        """Compute the targets of a dataset.

        Raises:
            DataError: the dataset is damaged, or its episodes are too short for any return.
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
        """The returns that are complete, (n,)."""
        return self.mc_return[self.mc_valid]

    def window(self, index: Tensor, length: int) -> dict[str, Tensor]:
        """Targets (B, length) of the windows that begin at rows ``index`` (B,).

        Past the dataset's end the last row is repeated.
        """
        rows = index.reshape(-1, 1).cpu() + torch.arange(length)
        rows = rows.clamp_max(len(self.mc_return) - 1)
        return {name: values[rows].to(index.device) for name, values in vars(self).items()}


def _episode_targets(reader: DatasetReader, index: int, config: ReturnConfig) -> tuple[Any, ...]:
    columns = reader.read_episode_columns(index, _COLUMNS)
    reward, done, truncated = (columns[name] for name in _COLUMNS)
    if not np.isfinite(reward).all():
        raise DataError.at(reader.data_path(index), "a reward is not a number", index)
    limit = reader.time_limit(index)
    return (
        mc_return(reward, config.gamma, config.steps),
        mc_valid(len(reward), limit, config.steps, config.keep_truncated),
        is_terminal(done, truncated),
        reward,
    )


def open_reader(root: Path, repo_id: str) -> DatasetReader:
    """The dataset that LeRobot has loaded from ``root``.

    Raises:
        DataError: it was not written by egovcp, or is damaged.
    """
    return DatasetReader(recorded(Path(root), repo_id))


def to_batch(batch: Mapping[str, Tensor], targets: Targets) -> Batch:
    """A batch of LeRobot's windows as the losses read it.

    Args:
        batch: observations (B, T, ...) of rows t .. t + T - 1 and actions (B, T + 1, 7) from
            row t - 1 on, with LeRobot's ``_is_pad`` masks and the ``index`` (B,) of row t.

    Raises:
        DataError: the depth is not in millimetres, or of another shape.
    """
    state, action = batch[spec.STATE_KEY], batch[spec.ACTION_KEY]
    valid = ~batch[f"{spec.STATE_KEY}_is_pad"]
    is_first = torch.zeros_like(valid)
    is_first[:, 0] = batch[f"{spec.ACTION_KEY}_is_pad"][:, 0]  # nothing comes before it
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
    )


def mirrored(rows: Batch, which: Tensor) -> Batch:
    """The batch with the windows ``which`` (B,) bool mirrored left to right."""

    def swap(value: Tensor, source: NDArray[np.intp], sign: NDArray[np.float32]) -> Tensor:
        other = value[..., torch.from_numpy(source).to(value.device)]
        other = other * torch.from_numpy(sign).to(value)
        return torch.where(which[:, None, None], other, value)

    return rows._replace(
        depth=torch.where(which[:, None, None, None], rows.depth.flip(-1), rows.depth),
        state=swap(rows.state, mirror.STATE_SOURCE, mirror.STATE_SIGN),
        action=swap(rows.action, mirror.ACTION_SOURCE, mirror.ACTION_SIGN),
        prev_action=swap(rows.prev_action, mirror.ACTION_SOURCE, mirror.ACTION_SIGN),
    )
