"""Does every episode of a dataset read, and line up in time?"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from egovcp import spec
from egovcp.checks.environment import COMMAND_TOLERANCE, commanded
from egovcp.cli import DatasetConfig
from egovcp.errors import DataError

if TYPE_CHECKING:
    from egovcp.data import Episode


def check_dataset(
    config: DatasetConfig, progress: Callable[[int, int], None] | None = None
) -> None:
    """Read every episode and check that the commands in its states line up with its actions.

    Args:
        progress: called with (episodes done, episodes in all).

    Raises:
        UsageError: the configuration names no dataset.
        DataError: a file is damaged, or a command is not the action sent one tick before.
        EnvironmentFailure: the Hub cannot be reached.
    """
    from egovcp.data import DatasetReader  # needs the extra egovcp[data]

    reader = DatasetReader.open(config)
    for index in range(len(reader)):
        _check_commands(reader.read(index), f"{reader.root}, episode {index}")
        if progress is not None:
            progress(index + 1, len(reader))


def _check_commands(episode: Episode, where: str) -> None:
    """The command in o_t is a_{t-1} as sent, and the neutral pose at t = 0."""
    before = np.vstack([np.zeros((1, spec.ACTION_DIM)), episode.action[:-1]])
    off = np.abs(commanded(episode.state) - spec.ACTION_BOX.to_metric(before)).max(axis=1)
    wrong = np.flatnonzero(off > COMMAND_TOLERANCE)
    if len(wrong):
        t = int(wrong[0])
        raise DataError(
            f"{where}, frame {t}: the command in the state is {off[t]:.3g} m from the action sent "
            "one tick before; the rows are shifted in time, or the action box differs"
        )
