"""Reads a LeRobot v3 dataset of any features: its tables and rows.

`DatasetReader` reads egovcp's own datasets; this reader makes no assumption about features, sizes
and rates. It keeps going after a problem, so that all problems can be listed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp.data import metadata, schema
from egovcp.data.features import Feature, parse_feature
from egovcp.data.parquet import data_errors, open_parquet
from egovcp.data.paths import files_below, require_file
from egovcp.errors import DataError

_TABLE_COLUMNS: Final = ("episode_index", "length", "dataset_from_index", "dataset_to_index")
_DATA_LOCATION_COLUMNS: Final = ("data/chunk_index", "data/file_index")
_VIDEO_LOCATION_COLUMNS: Final = ("chunk_index", "file_index", "from_timestamp")
#: The problem of a parquet file without a footer, which LeRobot writes at the end.
UNFINISHED: Final = (
    "the end of the file is missing: its recording was interrupted before LeRobot's finalize(), or "
    "it was copied incompletely; its rows are lost"
)


@dataclass(frozen=True)
class VideoSpan:
    """Part of a video file that shows an episode."""

    path: Path
    start_s: float


@dataclass(frozen=True)
class EpisodeRow:
    """A row of ``meta/episodes``."""

    table_path: Path
    index: int
    length: int
    start: int
    """Global index of the first frame."""
    end: int
    data_path: Path
    videos: Mapping[str, VideoSpan] = field(default_factory=dict)
    columns: Mapping[str, Any] = field(default_factory=dict)
    """All columns of the row."""

    @property
    def tasks(self) -> list[str]:
        return list(self.columns.get("tasks") or ())

    def stats(self, key: str) -> dict[str, Any]:
        """Recorded statistics of a feature; empty if there are none."""
        prefix = f"stats/{key}/"
        found = {k.removeprefix(prefix): v for k, v in self.columns.items() if k.startswith(prefix)}
        return found if any(value is not None for value in found.values()) else {}


class LeRobotReader:
    """A LeRobot v3 dataset in a folder."""

    def __init__(self, root: Path) -> None:
        """Read the `meta` folder; `problems` has what is wrong with the tables.

        Raises:
            DataError: ``info.json`` cannot be used.
        """
        self.root = root
        self.info: Mapping[str, Any] = metadata.load_v3_info(root)
        """``meta/info.json``."""
        self.features = {key: parse_feature(key, f) for key, f in self.info["features"].items()}
        self.problems: list[DataError] = []
        self.tasks: Mapping[int, str] = {}
        """``meta/tasks.parquet``: task index -> task."""
        self.stats: Mapping[str, Any] = {}
        """``meta/stats.json``."""
        self.rows: list[EpisodeRow] = []
        """``meta/episodes``, in order."""
        with self._noting_problems():
            self.tasks = metadata.load_tasks(root)
        with self._noting_problems():
            self.stats = metadata.load_stats(root)
        with self._noting_problems():
            for path in metadata.episode_files(root):
                with self._noting_problems():
                    self.rows += self._table_rows(path)

    @contextmanager
    def _noting_problems(self) -> Iterator[None]:
        try:
            yield
        except DataError as error:
            self.problems.append(explained(error))

    @classmethod
    def open(cls, root: Path) -> Self:
        """Read a dataset whose tables must be sound; raises the first of `problems`."""
        reader = cls(root)
        for error in reader.problems:
            raise error
        return reader

    @property
    def fps(self) -> float:
        return float(self.info["fps"])

    @property
    def num_frames(self) -> int:
        return sum(row.length for row in self.rows)

    @property
    def data_files(self) -> list[Path]:
        """All data files that are listed or present; LeRobot reads all of them."""
        present = [p for p in files_below(self.root / "data") if p.suffix == ".parquet"]
        return sorted({*present, *(row.data_path for row in self.rows)})

    def keys(self, dtype: str) -> list[str]:
        """The features of a dtype."""
        return [key for key, feature in self.features.items() if feature.dtype == dtype]

    @property
    def numeric(self) -> list[Feature]:
        """Features of numbers, without those that every dataset has."""
        return [
            f for k, f in self.features.items() if f.is_numeric and k not in schema.INDEX_FEATURES
        ]

    def open_data(self, path: Path) -> pq.ParquetFile:
        """Open a data file; raises `DataError`."""
        require_file(self.root, path)
        try:
            return open_parquet(path, own=False)
        except DataError as error:
            raise explained(error) from error

    def episodes(
        self, path: Path, keys: Sequence[str] | None = None
    ) -> Iterator[tuple[int, pa.Table] | DataError]:
        """(Number, rows) of each episode in a data file; ``keys`` selects columns.

        Unreadable parts are returned as errors.
        """
        try:
            file = self.open_data(path)
        except DataError as error:
            yield error
            return
        wanted = [*dict.fromkeys([*keys, "episode_index"])] if keys is not None else None
        yield from episode_runs(file, path, wanted)

    def read(self, row: EpisodeRow, keys: Sequence[str]) -> pa.Table:
        """Some columns of the rows of an episode.

        Raises:
            DataError: its rows or a column are missing or damaged, or the file is.
        """
        file = self.open_data(row.data_path)
        columns = [*dict.fromkeys([*keys, "episode_index"])]
        for found in episode_runs(file, row.data_path, columns, only=row.index):
            if isinstance(found, DataError):
                if found.episode in (None, row.index):
                    raise found
            elif found[0] == row.index:
                table = found[1]
                for key in columns:
                    if key not in table.column_names:
                        raise DataError.at(row.data_path, f"column {key} is missing", row.index)
                return table
        raise DataError.at(row.data_path, "has no rows of this episode", row.index)

    def _table_rows(self, path: Path) -> Iterator[EpisodeRow]:
        require_file(self.root, path)
        with data_errors(path):
            file = open_parquet(path, own=False)
            names = file.schema_arrow.names
            videos = self.keys("video")
            locations = [f"videos/{key}/{n}" for key in videos for n in _VIDEO_LOCATION_COLUMNS]
            required = (*_TABLE_COLUMNS, *_DATA_LOCATION_COLUMNS, *locations)
            for name in required:
                if name not in names:
                    raise DataError.at(path, f"column {name} is missing")
            rows = file.read().to_pylist()
        for number, row in enumerate(rows):
            if null := [name for name in required if row[name] is None]:
                problem = f"column {null[0]} is null in row {number}"
                self.problems.append(DataError.at(path, problem, row["episode_index"]))
                continue
            with data_errors(path):
                index, length, start, end = (int(row[name]) for name in _TABLE_COLUMNS)
                yield EpisodeRow(
                    path,
                    index,
                    length,
                    start,
                    end,
                    data_path=self._path(self.info["data_path"], row, "data"),
                    videos={key: self._span(key, row) for key in videos},
                    columns=row,
                )

    def _span(self, key: str, row: Mapping[str, Any]) -> VideoSpan:
        path = self._path(self.info["video_path"], row, f"videos/{key}", key)
        return VideoSpan(path, float(row[f"videos/{key}/from_timestamp"]))

    def _path(self, template: str, row: Mapping[str, Any], prefix: str, key: str = "") -> Path:
        numbers = {n: int(row[f"{prefix}/{n}"]) for n in ("chunk_index", "file_index")}
        return self.root / template.format(video_key=key, **numbers)


def is_own(root: Path) -> bool:
    """Whether the dataset claims to be one of egovcp's: it has ``meta/collection.json``, its
    actions name the low-level controller that executed them, or, if ``info.json`` cannot tell, it
    has ``meta/sha256.json``."""
    path = root / schema.COLLECTION_PATH
    if path.exists() or path.is_symlink():
        return True
    try:
        features = metadata.load_json_object(root / schema.INFO_PATH, root)["features"]
        return "controller_id" in features["action"]["info"]
    except (DataError, LookupError, TypeError):
        return (root / schema.HASHES_PATH).exists()


def explained(error: DataError) -> DataError:
    """The error; one of a parquet file without a footer says how that comes about."""
    if not any(text in error.problem for text in ("magic bytes", "Parquet file size is")):
        return error
    return DataError.at(error.file, f"{error.problem.rstrip('.')}; {UNFINISHED}", error.episode)


def episode_runs(
    file: pq.ParquetFile,
    path: Path,
    columns: Sequence[str] | None = None,
    only: int | None = None,
    listed: NDArray[np.int64] | None = None,
) -> Iterator[tuple[int, pa.Table] | DataError]:
    """(``episode_index``, rows) of the consecutive rows of each episode in a data file.

    Episodes may span row groups, which are read one at a time. A damaged one gives an error for
    each of its episodes, if they can be determined. Row groups whose statistics exclude the episode
    ``only`` are skipped. ``listed``, number and length (E, 2) of all episodes, replaces the column.
    """
    number, parts, row = -1, list[pa.Table](), 0
    for group in range(file.num_row_groups):
        first, row = row, row + file.metadata.row_group(group).num_rows
        given = None if listed is None else _numbers(listed, np.arange(first, row))
        try:
            with data_errors(path):
                if only is not None and not _may_hold(file.metadata.row_group(group), only):
                    continue
                table = file.read_row_group(group, columns=columns, use_threads=False)
                runs = list(_split_by_episode(table, given))
        except DataError as error:
            lost = _episode_numbers(file, group) if given is None else np.unique(given).tolist()
            if not lost:
                yield DataError.at(path, f"{error.problem} (row group {group})")
                continue
            if parts and number not in lost:  # complete; episodes are returned in order
                yield number, pa.concat_tables(parts)
            yield from (DataError.at(path, error.problem, n) for n in lost)
            parts = []
            continue
        for run_number, part in runs:
            if run_number != number and parts:
                yield number, pa.concat_tables(parts)
                parts = []
            number = run_number
            parts.append(part)
    if parts:
        yield number, pa.concat_tables(parts)


def _numbers(listed: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """The episodes (n,) of rows (n,) of a file with episodes ``listed``, see `episode_runs`."""
    return np.asarray(listed[np.searchsorted(listed[:, 1].cumsum(), rows, "right"), 0])


def _split_by_episode(
    table: pa.Table, numbers: NDArray[np.int64] | None
) -> Iterator[tuple[int, pa.Table]]:
    """Consecutive rows with the same number; None: with the same ``episode_index``."""
    if numbers is None:
        column = table["episode_index"]
        if column.null_count:
            raise DataError.without_place("column episode_index has a null value")
        numbers = np.asarray(column.to_numpy(), np.int64)
    edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    for first, last in itertools.pairwise(edges):
        if last > first:
            yield int(numbers[first]), table.slice(first, last - first)


def _episode_numbers(file: pq.ParquetFile, group: int) -> list[int]:
    """The episodes of a damaged row group, if that column is readable."""
    try:
        column = file.read_row_group(group, columns=["episode_index"], use_threads=False)[0]
        return sorted(set(column.drop_null().to_pylist()))
    except (pa.ArrowException, OSError):
        return []


def _may_hold(group: pq.RowGroupMetaData, episode: int) -> bool:
    """Whether the row group may hold rows of the episode, by its statistics."""
    for column in map(group.column, range(group.num_columns)):
        if column.path_in_schema == "episode_index" and column.is_stats_set:
            found = column.statistics
            return not found.has_min_max or found.min <= episode <= found.max
    return True
