"""A shard: one data file, and the file of the episodes table that belongs to it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq

from egovcp.data import files, schema, stats
from egovcp.data.encoded import EncodedEpisode, with_index
from egovcp.safe_files import sha256


def shard_paths(number: int) -> tuple[str, str]:
    """Relative paths of a shard's data file and of its file of the episodes table."""
    place = _place(number)
    return schema.DATA_PATH.format(**place), schema.EPISODES_PATH.format(**place)


def _place(number: int) -> dict[str, int]:
    chunk, file = divmod(number, schema.CHUNK_FILES)
    return {"chunk_index": chunk, "file_index": file}


class Shard:
    """Writes the files of shard ``number``; a row group per episode, so that one can be read alone.

    Both exist, complete and flushed, after `close`.
    """

    def __init__(self, folder: Path, number: int) -> None:
        self._folder = folder
        self._number = number
        self._data_path, self._episodes_path = shard_paths(number)
        self._file: IO[bytes] = files.create(folder / self._data_path)
        # depth is noise to a dictionary; snappy halves it at next to no cost
        self._writer = pq.ParquetWriter(
            self._file, schema.arrow_schema(), compression="snappy", use_dictionary=False
        )
        self._rows: list[dict[str, Any]] = []
        self._stats: list[stats.Matrix] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self, encoded: EncodedEpisode, episode_index: int, first_frame: int, task_index: int
    ) -> None:
        """Append an episode at its place in the dataset."""
        table, matrix = with_index(encoded, episode_index, first_frame, task_index)
        self._writer.write_table(table, row_group_size=table.num_rows)
        place = _place(self._number)
        self._rows.append(
            {
                "episode_index": episode_index,
                "tasks": [encoded.facts["task"]],
                "length": len(encoded),
                **{f"data/{name}": value for name, value in place.items()},
                "dataset_from_index": first_frame,
                "dataset_to_index": first_frame + len(encoded),
            }
        )
        self._stats.append(matrix)

    def close(self) -> tuple[stats.Matrix, int]:
        """Complete both files; statistics of all frames, and their number."""
        self._writer.close()
        self._file.close()
        counts = [row["length"] for row in self._rows]
        with files.create(self._folder / self._episodes_path) as file:
            pq.write_table(self._episodes_table(counts), file)
        for path in (self._data_path, self._episodes_path):
            files.sync(self._folder / path)
        return stats.aggregate(self._stats, counts), sum(counts)

    def abandon(self) -> None:
        """Close what is open, whatever state it is in."""
        with suppress(OSError, pa.ArrowException):
            self._writer.close()
        with suppress(OSError):
            self._file.close()

    def hashes(self) -> Mapping[str, str]:
        """SHA-256 of each file by its relative path."""
        return {
            path: sha256(self._folder / path) for path in (self._data_path, self._episodes_path)
        }

    def _episodes_table(self, counts: list[int]) -> pa.Table:
        table = pa.Table.from_pylist(self._rows)
        columns = stats.to_arrow(self._stats, counts)
        for name, value in _place(self._number).items():
            columns[f"meta/episodes/{name}"] = pa.array([value] * len(counts))
        for name, column in columns.items():
            table = table.append_column(name, column)
        return table
