"""[Batch, Time, Data]: whole datasets as arrays, in one line.

Everything at once, padded to the longest episode::

    data = load_arrays("data/ball")            # or a Hub id: load_arrays("me/egovcp-ball")
    data["action"]                             # (B, T, 7) float32
    data["valid"]                              # (B, T) bool, False where an episode is over

or episode by episode, read when it is asked for::

    for episode in open_dataset("data/ball"):
        episode.depth                          # (T, 48, 64) uint16, mm
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.cli import DatasetConfig
from egovcp.data import schema
from egovcp.data.reader import DatasetReader
from egovcp.errors import DataError, suggest
from egovcp.hub import is_local_path


def open_dataset(where: str | Path, revision: str = "") -> DatasetReader:
    """Open a dataset, a folder or an id on the Hub, for reading episode by episode.

    Args:
        where: a folder, or ``user/name``.
        revision: branch, tag or commit SHA, of a dataset on the Hub.

    Raises:
        UsageError: nothing is named, or a revision of a folder.
        DataError: there is no such folder, it is damaged, or not one of this specification.
        EnvironmentFailure: the Hub cannot be reached.
    """
    if not isinstance(where, str) or is_local_path(where):
        return DatasetReader.open(DatasetConfig(root=str(where), revision=revision))
    return DatasetReader.open(DatasetConfig(repo_id=str(where), revision=revision))


def load_arrays(
    dataset: str | Path | DatasetReader, columns: Sequence[str] = tuple(spec.FEATURES)
) -> dict[str, NDArray[Any]]:
    """Whole columns of a dataset of B episodes as (B, T, ...), T the longest episode's frames.

    Frames after the end of an episode are zeros, and False in ``valid``, which is (B, T) and always
    there. Depth takes 6 kB per frame: leave it out of ``columns`` where it is not needed.

    Args:
        dataset: a folder, an id on the Hub, or an open dataset.
        columns: LeRobot feature names, keys of ``schema.FEATURES``.

    Raises:
        DataError: there is no such column, or the dataset is damaged.
    """
    reader = dataset if isinstance(dataset, DatasetReader) else open_dataset(dataset)
    for name in columns:
        if name not in schema.FEATURES:
            raise DataError(f"no column {name!r}{suggest(name, schema.FEATURES)}")
    shape = (len(reader), int(reader.lengths.max()))
    out: dict[str, NDArray[Any]] = {name: _empty(name, shape) for name in columns}
    out["valid"] = np.arange(shape[1]) < reader.lengths[:, None]
    for index, length in enumerate(reader.lengths):
        for name, values in reader.read_episode_columns(index, columns).items():
            out[name][index, :length] = values
    return out


def _empty(name: str, shape: tuple[int, int]) -> NDArray[Any]:
    if name == spec.DEPTH_KEY:
        return np.zeros((*shape, spec.DEPTH_ROWS, spec.DEPTH_COLS), dtype=np.uint16)
    width = schema.width(name)
    dtype = str(schema.FEATURES[name]["dtype"])
    return np.zeros(shape if width == 1 else (*shape, width), dtype=dtype)
