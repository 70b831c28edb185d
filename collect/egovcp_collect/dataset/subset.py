"""Writes episodes of a LeRobot v3 dataset of any features to a new dataset.

Rows are copied, with new episode and frame indices. Video files are copied whole, because a video
may hold more than the dataset shows; nothing is encoded again.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp.checks.lerobot_dataset import LeRobotCheck
from egovcp.checks.lerobot_episode import Statistics, describe
from egovcp.data import dataset_files, schema
from egovcp.data.camera_images import decode_frames, decode_image, frame_times
from egovcp.data.features import Feature
from egovcp.data.lerobot import EpisodeRow, LeRobotReader, VideoSpan
from egovcp.data.paths import files_below
from egovcp.data.stats import QUANTILES, ROWS, aggregate_named
from egovcp.data.writer import new_dataset
from egovcp.errors import DataError

_SAMPLED_FRAMES: Final = 20  # for the statistics of a camera that are not recorded
_MOMENTS: Final = ROWS[: -len(QUANTILES)]
_QUANTILE_ROWS: Final = ROWS[-len(QUANTILES) :]


type Spans = Mapping[int, Mapping[str, VideoSpan]]
"""Number of an episode -> its part of each video."""


@dataclass(frozen=True)
class ValidEpisode:
    """An episode whose rows have no problem."""

    row: EpisodeRow
    """Its row in ``meta/episodes``; ``columns`` is empty if it is not listed there."""
    table: pa.Table
    """Its rows, with all columns."""
    values: dict[str, NDArray[Any]]
    """Its numbers and strings, (T, n) of each feature."""

    @property
    def length_problem(self) -> DataError | None:
        """An error if ``meta/episodes`` lists it with another number of frames."""
        listed, found = self.row.length, len(self.table)
        if listed == found or not self.row.columns:
            return None
        problem = f"meta/episodes gives it {listed} frames, but it has {found}"
        return DataError.at(self.row.data_path, problem, self.row.index)


def scan_episodes(reader: LeRobotReader) -> Iterator[ValidEpisode | DataError]:
    """Each valid episode once, in the order of the data files, and the problems of the others.

    Missing metadata is rebuilt: task names from the episodes with exactly one task; the video
    position of an unlisted episode if the videos hold exactly the frames of all episodes.
    """
    check = LeRobotCheck(reader, every=True)
    if missing := list(check.index_feature_problems()):
        yield from missing
        return
    columns = [k for k, f in reader.features.items() if f.dtype != "video"]
    spans = cache(partial(_rebuilt_spans, reader))
    reader.tasks = reader.tasks or _named_tasks(reader)
    seen = set[int]()
    for path in reader.data_files:
        for part in reader.episodes(path, columns):
            if isinstance(part, DataError):
                yield part
                seen |= {part.episode} if part.episode is not None else set()
                continue
            number, table = part
            if number in seen:
                problem = (
                    "it has rows in another place: they are not together, or its episode_index is "
                    "repeated"
                )
                yield DataError.at(path, problem, number)
                continue
            seen.add(number)
            yield from _examine(check, spans, path, number, table)
    for row in reader.rows:
        if row.index not in seen:
            seen.add(row.index)
            yield DataError.at(row.data_path, "its rows cannot be read", row.index)


def _examine(
    check: LeRobotCheck, spans: Callable[[], Spans], path: Path, number: int, table: pa.Table
) -> Iterator[ValidEpisode | DataError]:
    row = check.by_number.get(number) or EpisodeRow(
        table_path=path, index=number, length=0, start=0, end=0, data_path=path
    )
    if check.reader.keys("video"):
        row = replace(row, videos=row.videos or spans().get(number, {}))
    if missing := sorted(set(check.reader.keys("video")) - set(row.videos)):
        problem = "meta/episodes does not list it, and the videos do not tell where it is"
        yield DataError.at(path, f"{problem} in {missing[0]}", number)
        return
    if not check.reader.tasks:
        problem = f"{schema.TASKS_PATH} and meta/episodes are lost, or name no task"
        yield DataError.at(path, f"no text of its task is known: {problem}", number)
        return
    check.by_number[number] = row
    for found in check.episode_problems(path, number, table):
        if isinstance(found, DataError):
            yield found
        else:
            yield ValidEpisode(replace(row, data_path=path), table, found)


def _named_tasks(reader: LeRobotReader) -> dict[int, str]:
    """Task index -> task, from the episodes with exactly one task."""
    named = {row.index: row.tasks[0] for row in reader.rows if len(row.tasks) == 1}
    tasks: dict[int, str] = {}
    for path in reader.data_files:
        for part in reader.episodes(path, ["task_index"]):
            if isinstance(part, DataError):
                continue
            number, table = part
            if number in named and "task_index" in table.column_names:
                tasks.setdefault(table["task_index"][0].as_py(), named[number])
    return tasks


def _rebuilt_spans(reader: LeRobotReader) -> Spans:
    """Episode -> where each video shows it; empty unless every camera's files, in order, hold
    exactly all episodes."""
    lengths: dict[int, int] = {}
    spans: dict[int, dict[str, VideoSpan]] = {}
    for path in reader.data_files:
        for part in reader.episodes(path, ["episode_index"]):
            if not isinstance(part, DataError):
                lengths[part[0]] = lengths.get(part[0], 0) + len(part[1])
    for key in reader.keys("video"):
        waiting = list(lengths.items())
        try:
            for path in files_below(reader.root / "videos" / key):
                times, used = frame_times(path), 0
                while waiting and used + waiting[0][1] <= len(times):
                    number, length = waiting.pop(0)
                    spans.setdefault(number, {})[key] = VideoSpan(path, float(times[used]))
                    used += length
                if used != len(times):
                    raise DataError.at(path, "holds other frames")
        except DataError:
            return {}
        if waiting:
            return {}
    return spans


class SubsetWriter:
    """Writes valid episodes, in the order of the data files of their dataset, to the new folder
    ``folder``; call `finish` at the end."""

    def __init__(self, reader: LeRobotReader, folder: Path) -> None:
        self._reader, self._folder = reader, folder
        self._source: Path | None = None
        self._writer: pq.ParquetWriter | None = None
        self._files = 0
        self._rows: list[dict[str, Any]] = []
        self._stats: dict[str, list[tuple[int, Statistics]]] = {}
        self.num_frames = 0

    @property
    def num_episodes(self) -> int:
        return len(self._rows)

    def add(self, episode: ValidEpisode) -> None:
        """Append an episode."""
        number, count = self.num_episodes, len(episode.table)
        table = episode.table
        index = np.arange(self.num_frames, self.num_frames + count)
        for name, values in (("index", index), ("episode_index", np.full(count, number))):
            at = table.schema.get_field_index(name)
            field = table.schema.field(at)
            table = table.set_column(at, field, pa.array(values, field.type))
        if episode.row.data_path != self._source:  # one file for each of the source
            self._close()
            path = self._folder / self._data_path(self._files)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, table.schema, compression="snappy")
            self._source, self._files = episode.row.data_path, self._files + 1
        assert self._writer is not None
        self._writer.write_table(table, row_group_size=count)
        self._rows.append(self._row(episode, number, count))
        self.num_frames += count
        for span in episode.row.videos.values():
            target = self._folder / span.path.relative_to(self._reader.root)
            if not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(span.path, target)

    def finish(self) -> None:
        """Write the tables."""
        self._close()
        reader, count = self._reader, self.num_episodes
        tasks = {name: number for number, name in reader.tasks.items()}
        info = dict(reader.info)
        totals = {"total_episodes": count, "total_frames": self.num_frames}
        info |= {**totals, "total_tasks": len(tasks), "splits": {"train": f"0:{count}"}}
        total = {key: aggregate_named(parts) for key, parts in self._stats.items()}
        counts = {key: sum(n for n, _ in self._stats[key]) for key in total}
        stats = {
            key: {**{name: v.tolist() for name, v in value.items()}, "count": [counts[key]]}
            for key, value in total.items()
        }
        dataset_files.create_json(self._folder / schema.INFO_PATH, info)
        dataset_files.create_json(self._folder / schema.STATS_PATH, stats)
        frame = pd.DataFrame({"task_index": list(tasks.values())}, pd.Index(tasks, name="task"))
        frame.to_parquet(self._folder / schema.TASKS_PATH)
        path = self._folder / schema.EPISODES_PATH.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        in_all = {f"stats/{key}/{name}" for key, found in stats.items() for name in found}
        columns = dict.fromkeys(name for row in self._rows for name in row)
        names = [n for n in columns if not n.startswith("stats/") or n in in_all]
        rows = [{name: row.get(name) for name in names} for row in self._rows]
        pq.write_table(pa.Table.from_pylist(rows), path)

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer = None

    def _data_path(self, number: int) -> str:
        size = self._reader.info.get("chunks_size")
        chunk, file = divmod(number, size if type(size) is int and size > 0 else schema.CHUNK_FILES)
        return str(self._reader.info["data_path"]).format(chunk_index=chunk, file_index=file)

    def _row(self, episode: ValidEpisode, number: int, count: int) -> dict[str, Any]:
        """Its row in ``meta/episodes``."""
        reader, old = self._reader, episode.row
        tasks = dict.fromkeys(episode.values["task_index"][:, 0].tolist())
        path = self._data_path(self._files - 1)
        row = {k: v for k, v in old.columns.items() if not k.startswith(("stats/", "videos/"))}
        row |= {
            "episode_index": number,
            "tasks": [reader.tasks[task] for task in tasks],
            "length": count,
            **_file_indices(reader.info["data_path"], path, "data"),
            "dataset_from_index": self.num_frames,
            "dataset_to_index": self.num_frames + count,
            **{f"meta/episodes/{name}": 0 for name in ("chunk_index", "file_index")},
        }
        for key, span in old.videos.items():
            name = span.path.relative_to(reader.root).as_posix()
            template = str(reader.info["video_path"]).replace("{video_key}", key)
            row |= _file_indices(template, name, f"videos/{key}")
            row[f"videos/{key}/from_timestamp"] = span.start_s
            row[f"videos/{key}/to_timestamp"] = span.start_s + count / reader.fps
        for key, feature in reader.features.items():
            frames, stats = self._statistics(episode, feature, number)
            if stats:
                self._stats.setdefault(key, []).append((frames, stats))
                row |= {f"stats/{key}/{name}": value.tolist() for name, value in stats.items()}
                row[f"stats/{key}/count"] = [frames]
        return row

    def _statistics(
        self, episode: ValidEpisode, feature: Feature, number: int
    ) -> tuple[int, Statistics]:
        """(number of frames, statistics) of a feature. Strings have none. Those of cameras are the
        recorded ones, or computed from up to 20 frames."""
        key, count = feature.key, len(episode.table)
        if feature.is_camera:
            recorded = {k: v for k, v in episode.row.stats(key).items() if v is not None}
            frames = (recorded.pop("count", None) or [count])[0]
            if recorded.keys() >= {*_MOMENTS}:  # one converted from v2.1 has no quantiles
                return frames, {name: np.array(v, np.float64) for name, v in recorded.items()}
            return _camera_statistics(episode, feature, self._reader.fps)
        if key not in episode.values or not feature.is_numeric:
            return count, {}
        values = episode.values[key]
        if key in ("index", "episode_index"):
            first, step = (number, 0) if key == "episode_index" else (self.num_frames, 1)
            values = first + step * np.arange(count)[:, None]
        values = values.reshape(-1, feature.shape[-1])  # LeRobot reduces all axes but the last
        return count, _with_quantiles(values)


def _with_quantiles(values: NDArray[Any]) -> Statistics:
    quantiles = np.quantile(values.astype(np.float64), QUANTILES, axis=0)
    return {**describe(values), **dict(zip(_QUANTILE_ROWS, quantiles, strict=True))}


def _camera_statistics(
    episode: ValidEpisode, feature: Feature, fps: float
) -> tuple[int, Statistics]:
    """Statistics per channel of up to 20 frames, (C, 1, 1) each, of colours in [0, 1]."""
    count = len(episode.table)
    places = np.unique(np.linspace(0, count - 1, min(count, _SAMPLED_FRAMES)).round().astype(int))
    if feature.dtype == "video":
        if feature.is_depth:
            return 0, {}  # its values are codes of a quantisation
        span = episode.row.videos[feature.key]
        frames = decode_frames(span.path, span.start_s + places / fps)
        images = [frame.to_ndarray(format="rgb24") for frame in frames]
    else:
        column = episode.table[feature.key]
        contents = [(place, column[place].as_py()) for place in places.tolist()]
        images = [np.asarray(decode_image(c, place, feature.key)) for place, c in contents]
    pixels = np.concatenate(
        [image.reshape(image.shape[0] * image.shape[1], -1) for image in images]
    )
    stats = _with_quantiles(pixels if feature.is_depth else pixels / 255.0)
    return len(images), {name: value[:, None, None] for name, value in stats.items()}


def _file_indices(template: str, path: str, prefix: str) -> dict[str, int]:
    """`{prefix}/chunk_index` and `{prefix}/file_index` of ``path``, which follows ``template``."""
    pattern = re.escape(template)
    for name in ("chunk_index", "file_index"):
        pattern = re.sub(rf"\\\{{{name}(:[^}}]*)?\\\}}", rf"(?P<{name}>\\d+)", pattern, count=1)
    found = re.fullmatch(pattern, path)
    if found is None:
        raise DataError(f"{path} is not a file of the template {template}")
    return {f"{prefix}/{name}": int(number) for name, number in found.groupdict().items()}


def write_subset(reader: LeRobotReader, episodes: Sequence[int], root: Path) -> tuple[int, int]:
    """Write the episodes with these numbers to the new dataset ``root``; returns how many
    episodes and frames.

    Raises:
        DataError: one of them has a problem, a part of a file is unreadable, or the dataset's
            episodes are not numbered 0 to N - 1.
    """
    if [row.index for row in reader.rows] != list(range(len(reader.rows))):
        problem = "its episodes are not numbered from 0 without gaps"
        raise DataError(f"{reader.root}: {problem}; `egovcp-dataset repair` renumbers them")
    wanted = set(episodes)
    with new_dataset(root) as folder:
        writer = SubsetWriter(reader, folder)
        for found in scan_episodes(reader):
            error = found if isinstance(found, DataError) else found.length_problem
            if error is not None and (error.episode is None or error.episode in wanted):
                raise DataError(f"{error}; `egovcp-dataset repair` keeps the valid episodes")
            if isinstance(found, ValidEpisode) and found.row.index in wanted:
                writer.add(found)
        writer.finish()
    return writer.num_episodes, writer.num_frames
