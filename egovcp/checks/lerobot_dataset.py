"""Check of a LeRobot v3 dataset of any features: tables, rows, images, videos, statistics.

It finds what LeRobot would read wrongly, or stop at. `egovcp.checks.dataset` adds the contract of
egovcp's own datasets.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp.checks.lerobot_episode import (
    Statistics,
    camera_statistics_problems,
    check_images,
    check_size,
    describe,
    first_difference,
    span_problem,
    statistics_problems,
    value_problems,
)
from egovcp.data import schema
from egovcp.data.camera_images import decode_frames, frame_times
from egovcp.data.features import values_of
from egovcp.data.lerobot import EpisodeRow, LeRobotReader, episode_runs
from egovcp.data.parquet import data_errors
from egovcp.data.paths import files_below, require_file
from egovcp.data.stats import aggregate_named
from egovcp.errors import DataError, SchemaError

type Progress = Callable[[int, int], None]

#: LeRobot's editing tools copy these statistics unchanged from the source dataset.
STALE: Final = ("index", "episode_index", "task_index")
_RANGE: Final = re.compile(r"(\d{1,18}):(\d{1,18})", re.ASCII)


def lerobot_problems(
    root: Path, progress: Progress | None = None, notes: list[str] | None = None
) -> Iterator[DataError]:
    """All problems of a LeRobot v3 dataset; what is not checked is appended to ``notes``."""
    try:
        reader = LeRobotReader(root)
    except DataError as error:
        yield error
        return
    check = LeRobotCheck(reader)
    yield from reader.problems
    yield from check.table_problems()
    for path in reader.data_files:
        yield from check.file_problems(path, progress)
    yield from check.total_problems()
    if notes is not None:
        notes += check.notes()


class LeRobotCheck:
    """The checks of one dataset; call `table_problems`, then `file_problems` of every data file in
    order, then `total_problems`. A `SchemaError` is reported once for each file and feature, or, if
    ``every``, for each episode."""

    def __init__(self, reader: LeRobotReader, every: bool = False) -> None:
        self.reader, self._every = reader, every
        table = reader.root / "meta" / "episodes"
        self._has_table = not any(Path(e.file).is_relative_to(table) for e in reader.problems)
        ends = [0, *(row.end for row in reader.rows)]
        in_order = all(row.start == end for row, end in zip(reader.rows, ends, strict=False))
        self.by_number: dict[int, EpisodeRow] = {}
        """Number N -> row N of ``meta/episodes``, or, if ``every`` or rows are missing, the first
        with this ``episode_index``."""
        for number, row in enumerate(reader.rows):
            self.by_number.setdefault(row.index if every or not in_order else number, row)
        self._seen: dict[int, Path] = {}
        self._frames = 0
        self._reported: set[tuple[Path, str]] = set()
        self._sums: dict[str, list[tuple[int, Statistics]]] = {}
        self._valid_frames = 0
        self._has_av = importlib.util.find_spec("av") is not None
        self._times = lru_cache(maxsize=16)(frame_times)

    def table_problems(self) -> Iterator[DataError]:
        """Problems of ``info.json`` and ``meta/episodes``."""
        reader, info = self.reader, self.reader.root / schema.INFO_PATH
        yield from self.index_feature_problems()
        names = set(reader.tasks.values())
        end = 0
        for number, row in enumerate(reader.rows):
            for problem in _row_problems(row, number, end) if self._has_table else ():
                yield DataError.at(row.table_path, problem, row.index)
            end = row.end
            if unknown := sorted(set(row.tasks) - names) if names else []:
                problem = f"its task {unknown[0]!r} is not in {schema.TASKS_PATH}"
                yield DataError.at(row.table_path, problem, row.index)
        if not reader.problems:
            totals = {
                "total_episodes": (len(reader.rows), "meta/episodes lists"),
                "total_frames": (reader.num_frames, "the lengths in meta/episodes add up to"),
                "total_tasks": (len(reader.tasks), f"{schema.TASKS_PATH} lists"),
            }
            for name, (count, source) in totals.items():
                if reader.info.get(name) != count:
                    problem = f"{name} is {reader.info.get(name)}, but {source} {count}"
                    yield DataError.at(info, problem)
            for problem in split_problems(reader.info, len(reader.rows)):
                yield DataError.at(info, problem)

    def index_feature_problems(self) -> Iterator[DataError]:
        """The features of indices and times that ``info.json`` lacks."""
        for key in schema.INDEX_FEATURES:
            if key not in self.reader.features:
                problem = f"feature {key} is missing; LeRobot adds it to all data"
                yield DataError.at(self.reader.root / schema.INFO_PATH, problem)

    def file_problems(self, path: Path, progress: Progress | None = None) -> Iterator[DataError]:
        """Problems of a data file, its episodes, and their videos and statistics."""
        lengths = {n: row.length for n, row in self.by_number.items() if row.data_path == path}
        listed, rows = [*lengths], sum(lengths.values())
        try:
            file = self.reader.open_data(path)
            names = file.schema_arrow.names
            starts = np.cumsum([0, *lengths.values()])
            fits = 0 < starts[-1] == file.metadata.num_rows and _begin_at(file, path, starts[:-1])
            if not fits and "episode_index" not in names:
                raise DataError.at(path, "lacks the column episode_index")
        except DataError as error:
            self._frames += rows
            problem = f"{error.problem}{_lost(listed)}"
            yield DataError.at(path, problem, listed[0] if listed else None)
            return
        columns = [k for k, f in self.reader.features.items() if f.dtype != "video"]
        if unknown := sorted(set(names) - set(columns)):
            problem = f"columns that {schema.INFO_PATH} does not know: {', '.join(unknown)}"
            yield DataError.at(path, problem)
        present = [k for k in dict.fromkeys([*columns, "episode_index"]) if k in names]
        found, damaged = set[int](), set[int]()
        # If the listed episodes begin where frame_index is 0, episode_index is checked, not used.
        episodes = np.array([*lengths.items()]) if fits else None
        for part in episode_runs(file, path, present, listed=episodes):
            if isinstance(part, DataError):
                yield part
                if part.episode in self.by_number and part.episode not in found:
                    self._frames += self.by_number[part.episode].length
                    found.add(part.episode)
                    damaged.add(part.episode)
                continue
            number, table = part
            if number in damaged:  # its rows in another row group
                continue
            found.add(number)
            yield from self._listed_episode_problems(path, number, table)
            if progress is not None:
                progress(len(self._seen), max(len(self.reader.rows), len(self._seen)))
        for number in listed:
            if number not in found:
                yield DataError.at(path, "meta/episodes lists it here, but it has no row", number)

    def total_problems(self) -> Iterator[DataError]:
        """Problems of the whole: episodes in no table, and ``stats.json``."""
        reader = self.reader
        if self._has_table and (unlisted := sorted(set(self._seen) - set(self.by_number))):
            more = f" (and {len(unlisted) - 1} more)" if len(unlisted) > 1 else ""
            problem = f"its rows are here, but meta/episodes does not list it{more}"
            yield DataError.at(self._seen[unlisted[0]], problem, unlisted[0])
        path = reader.root / schema.STATS_PATH
        complete = self._valid_frames == self._frames == reader.num_frames
        for key, feature in reader.features.items():
            found = reader.stats.get(key)
            if not isinstance(found, dict) or key in STALE:
                continue
            if feature.is_camera:
                problems = camera_statistics_problems(found, feature)
            elif complete and key in self._sums:
                problems = statistics_problems(found, aggregate_named(self._sums[key]), feature)
            else:
                continue
            yield from (DataError.at(path, f"{key}: {problem}") for problem in problems)

    def notes(self) -> list[str]:
        """What is not checked, one line each."""
        features, stats = self.reader.features, self.reader.stats
        cameras = [key for key, feature in features.items() if feature.is_camera]
        language = self.reader.keys("language")
        lacking = [
            key for key, f in features.items() if key not in stats and (f.is_numeric or f.is_camera)
        ]
        videos = self.reader.keys("video")
        notes = [
            f"statistics of {', '.join(STALE)}, which LeRobot's editing tools copy from their "
            "source",
            "how it was collected: there is no meta/collection.json",
        ]
        if videos and self._has_av:
            notes.append(
                f"videos ({', '.join(videos)}): all times are checked, but of each episode only "
                "the first and the last frame are decoded"
            )
        elif videos:
            notes.append(
                f"videos ({', '.join(videos)}): PyAV is not installed; pip install 'egovcp[video]'"
            )
        else:
            notes.append("timestamps against frame_index / fps, which may differ without videos")
        if cameras:
            notes.append(
                f"statistics of cameras ({', '.join(cameras)}) against their pixels, of which "
                "LeRobot samples some"
            )
        if lacking and stats:
            notes.append(f"statistics of {', '.join(lacking)}: none are recorded")
        if language:
            notes.append(f"content of {', '.join(language)}")
        if not {"next.reward", "next.done"} & features.keys():
            notes.append(
                "reward, success and end of episodes: there is no next.reward or next.done"
            )
        if files_below(self.reader.root / "images"):
            notes.append(
                "images/, the frames of an interrupted recording, which LeRobot does not read; "
                "remove it to save space"
            )
        return notes

    def episode_problems(
        self, path: Path, number: int, table: pa.Table
    ) -> Iterator[DataError | dict[str, NDArray[Any]]]:
        """Problems of the rows of an episode and of its videos; at the end its numeric values,
        (T, n) of each feature, if there is no problem."""
        problems = 0
        values: dict[str, NDArray[Any]] = {}
        for key, feature in self.reader.features.items():
            if feature.dtype in ("video", "language"):
                continue
            try:
                if key not in table.column_names:
                    raise SchemaError.without_place(f"lacks the column {key} of {schema.INFO_PATH}")
                if feature.dtype == "image":
                    check_images(table[key], feature)
                    continue
                values[key] = values_of(table[key], feature)
            except DataError as error:
                problems += 1
                of_file = isinstance(error, SchemaError) and not self._every
                if not of_file or (path, key) not in self._reported:
                    yield DataError.at(path, error.problem, number, error.frame)
                if of_file:
                    self._reported.add((path, key))
        for frame, problem in value_problems(values, self.reader):
            problems += 1
            yield DataError.at(path, problem, number, frame)
        row = self.by_number.get(number)
        if row is not None and "timestamp" in values:
            times = values["timestamp"][:, 0].astype(np.float64)
            for video_error in self.video_problems(row, times):
                problems += 1
                yield video_error
        if not problems:
            yield values

    def video_problems(self, row: EpisodeRow, times: NDArray[np.float64]) -> Iterator[DataError]:
        """Problems of the videos of an episode with timestamps (T,), s."""
        for key, span in row.videos.items() if self._has_av else ():
            path, problem, frame = span.path, "", None
            try:
                require_file(self.reader.root, path)
                shown = self._times(path)
                frame, problem = span_problem(shown, span.start_s + times)
                if not problem:
                    near = np.abs(shown[:, None] - (span.start_s + times[[0, -1]])).argmin(0)
                    for at in near.tolist():
                        image = next(decode_frames(path, [shown[at]]), None)
                        if image is None:
                            raise DataError.at(path, "the video is damaged: a frame is unreadable")
                        check_size((image.width, image.height), self.reader.features[key])
            except DataError as error:
                problem = error.problem or str(error)
            if problem:
                yield DataError.at(path, problem, row.index, frame)

    def _listed_episode_problems(
        self, path: Path, number: int, table: pa.Table
    ) -> Iterator[DataError]:
        row = self.by_number.get(number)
        first, self._frames = self._frames, self._frames + (row.length if row else len(table))
        if number in self._seen:
            problem = f"its rows are not together: it also has rows in {self._seen[number].name}"
            yield DataError.at(path, f"{problem}, or its episode_index is repeated", number)
        self._seen.setdefault(number, path)
        if row is not None:
            if row.data_path != path:
                place = row.data_path.relative_to(self.reader.root)
                yield DataError.at(path, f"meta/episodes lists it in {place}", number)
            if row.length != len(table):
                problem = f"meta/episodes gives it {row.length} frames, but it has {len(table)}"
                yield DataError.at(path, problem, number)
            elif row.start != first:
                problem = f"meta/episodes says that it begins at row {row.start} of the dataset"
                yield DataError.at(path, f"{problem}, but it begins at row {first}", number)
        values = None
        for found in self.episode_problems(path, number, table):
            if isinstance(found, DataError):
                yield found
            else:
                values = found
        if values is None:
            return
        for key, start, step in (("episode_index", number, 0), ("index", first, 1)):
            counts = start + step * np.arange(len(table))
            at = first_difference(values[key][:, 0], counts) if key in values else None
            if at is not None:
                problem = f"column {key} is {values[key][at, 0]}, expected {counts[at]}"
                yield DataError.at(path, problem, number, at)
                if key == "episode_index":  # its statistics are of other rows
                    return
        self._valid_frames += len(table)
        for key, feature in self.reader.features.items():
            if key not in values or not feature.is_numeric or key in STALE:
                continue
            # LeRobot reduces all axes but the last.
            statistics = describe(values[key].reshape(-1, feature.shape[-1]))
            self._sums.setdefault(key, []).append((len(table), statistics))
            if row is not None and (recorded := row.stats(key)):
                for problem in statistics_problems(recorded, statistics, feature):
                    yield DataError.at(row.table_path, f"statistics of {key}: {problem}", number)


def _begin_at(file: pq.ParquetFile, path: Path, rows: NDArray[np.int64]) -> bool:
    """Whether ``frame_index`` is 0 in these rows and in no other."""
    try:
        with data_errors(path):
            table = file.read(columns=["frame_index"], use_threads=False)
    except DataError:
        return False
    return np.array_equal(np.flatnonzero(np.asarray(table) == 0), rows)


def _row_problems(row: EpisodeRow, number: int, end: int) -> Iterator[str]:
    """Problems of row ``number`` of the table; the episode before it ends at ``end``."""
    if row.index != number:
        yield f"listed in row {number}; episode_index counts from 0, and each episode has one row"
    frames = row.end - row.start
    if row.length != frames or row.length < 1:
        place = f"dataset_from_index {row.start} and dataset_to_index {row.end}"
        yield f"its length is {row.length}, but {place} give {frames} frames"
    if row.start != end:
        yield f"its dataset_from_index is {row.start}, but the episode before it ends at {end}"


def split_problems(info: Mapping[str, Any], episodes: int) -> Iterator[str]:
    """Problems of the ``splits`` of ``info.json``."""
    splits = info.get("splits")
    if not isinstance(splits, dict) or not splits:
        yield f"splits is {splits!r}, expected ranges of episodes such as {{'train': '0:9'}}"
        return
    for name, text in splits.items():
        found = _RANGE.fullmatch(text) if isinstance(text, str) else None
        if found is None or not int(found[1]) <= int(found[2]) <= episodes:
            yield f"split {name} is {text!r}, expected a range within 0:{episodes}"


def _lost(episodes: list[int]) -> str:
    """`` (episodes 3 to 7)`` for those that a file holds."""
    if not episodes:
        return ""
    first, last = min(episodes), max(episodes)
    return f" (episode {first})" if first == last else f" (episodes {first} to {last})"
