"""The two parquet series of a dataset: frames, and the table of episodes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema, stats, tiff

_EPISODES_PER_FLUSH = 256  # rows of the episodes table kept in memory


class RollingParquet:
    """A series of parquet files named by chunk and file index; one row group per write."""

    def __init__(self, folder: Path, template: str, dictionary: bool) -> None:
        """Files are opened on the first write to each.

        Args:
            folder: the dataset's root.
            template: relative path with ``chunk_index`` and ``file_index``.
            dictionary: use dictionary encoding (not worth its time for depth).
        """
        self._folder = folder
        self._template = template
        self._dictionary = dictionary
        self._file: IO[bytes] | None = None
        self._writer: pq.ParquetWriter | None = None
        self._number = 0

    @property
    def chunk_index(self) -> int:
        """Chunk of the current file."""
        return self._number // schema.CHUNK_FILES

    @property
    def file_index(self) -> int:
        """Number of the current file within its chunk."""
        return self._number % schema.CHUNK_FILES

    @property
    def bytes_written(self) -> int:
        """Size of the current file so far."""
        return 0 if self._file is None else self._file.tell()

    def write(self, table: pa.Table) -> None:
        """Append ``table`` as one row group."""
        if self._writer is None:
            self._open(table.schema)
        assert self._writer is not None
        self._writer.write_table(table, row_group_size=max(1, table.num_rows))

    def roll(self) -> None:
        """Close the current file; the next write begins another."""
        self.close()
        self._number += 1

    def close(self) -> None:
        """Write the footer of the current file, if one is open."""
        if self._writer is not None and self._file is not None:
            self._writer.close()
            self._file.close()
            self._writer = self._file = None

    def _open(self, arrow_schema: pa.Schema) -> None:
        name = self._template.format(chunk_index=self.chunk_index, file_index=self.file_index)
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._writer = pq.ParquetWriter(
            self._file, arrow_schema, compression="snappy", use_dictionary=self._dictionary
        )


class EpisodesTable:
    """``meta/episodes``: one row per episode with its place in the files and its statistics."""

    def __init__(self, folder: Path) -> None:
        self._files = RollingParquet(folder, schema.EPISODES_PATH, dictionary=True)
        self._rows: list[dict[str, Any]] = []
        self._stats: list[stats.Matrix] = []
        self._flushed: list[tuple[stats.Matrix, int]] = []

    def add(self, row: dict[str, Any], episode_stats: stats.Matrix) -> None:
        """Append an episode; rows reach the disk in batches."""
        self._rows.append(row)
        self._stats.append(episode_stats)
        if len(self._rows) >= _EPISODES_PER_FLUSH:
            self._flush()

    def close(self) -> stats.Matrix:
        """Write what is left and return the statistics of the whole dataset."""
        if self._rows:
            self._flush()
        self._files.close()
        matrices, counts = zip(*self._flushed, strict=True)
        return stats.aggregate(matrices, counts)

    def _flush(self) -> None:
        counts = [row["length"] for row in self._rows]
        table = pa.Table.from_pylist(self._rows)
        columns = stats.to_arrow(self._stats, counts)
        columns["meta/episodes/chunk_index"] = pa.array([self._files.chunk_index] * len(counts))
        columns["meta/episodes/file_index"] = pa.array([self._files.file_index] * len(counts))
        for name, column in columns.items():
            table = table.append_column(name, column)
        self._files.write(table)
        self._flushed.append((stats.aggregate(self._stats, counts), sum(counts)))
        self._rows, self._stats = [], []


def data_table(depth: NDArray[np.uint16], columns: Mapping[str, NDArray[np.generic]]) -> pa.Table:
    """The frames of an episode in ``schema.arrow_schema()``.

    Args:
        depth: (T, H, W) mm.
        columns: every key of ``schema.NUMERIC_KEYS``, (T,) or (T, n).
    """
    names = [f"frame-{i:06d}.tiff" for i in range(len(depth))]
    image = pa.StructArray.from_arrays([tiff.encode(depth), pa.array(names)], ["bytes", "path"])
    arrays: dict[str, pa.Array] = {spec.DEPTH_KEY: image}
    for key in schema.NUMERIC_KEYS:
        values = np.ascontiguousarray(columns[key])
        flat = pa.array(values.reshape(-1))
        arrays[key] = (
            flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        )
    ordered = schema.arrow_schema()
    return pa.Table.from_arrays([arrays[field.name] for field in ordered], schema=ordered)
