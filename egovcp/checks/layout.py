"""Do the files and tables of a dataset hold what `meta/info.json` says, and nothing else?"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from egovcp.data import DatasetReader, metadata, schema
from egovcp.data.parquet import data_errors, open_parquet
from egovcp.data.paths import files_below, require_file
from egovcp.errors import DataError

_RANGE = re.compile(r"(\d{1,18}):(\d{1,18})", re.ASCII)


def file_problems(reader: DatasetReader) -> Iterator[DataError]:
    """Data files that are missing, hold too much, or that no table lists.

    LeRobot and `datasets` read whatever lies in ``data``, listed or not.
    """
    expected = reader.frames_per_file
    for path, frames in expected.items():
        try:
            yield from _content_problems(reader, path, frames)
        except DataError as error:
            yield error if error.file else DataError.at(path, str(error))
    for path in files_below(reader.root / "data"):
        if path not in expected:
            problem = "listed in no table, yet LeRobot and `datasets` would read it; remove it"
            yield DataError.at(path, problem)


def _content_problems(reader: DatasetReader, path: Path, frames: int) -> Iterator[DataError]:
    require_file(reader.root, path)
    with data_errors(path):
        file = open_parquet(path)
        rows, columns = file.metadata.num_rows, set(file.schema_arrow.names)
    if rows != frames:
        yield DataError.at(path, f"holds {rows} frames, but meta/episodes lists {frames}")
    unknown = sorted(columns - set(reader.info["features"]))
    if unknown:
        problem = f"columns that {schema.INFO_PATH} does not know: {', '.join(unknown)}"
        yield DataError.at(path, problem)


def table_problems(reader: DatasetReader) -> Iterator[DataError]:
    """Tasks and splits that do not fit the episodes."""
    path, info = reader.root / schema.INFO_PATH, reader.info
    if info.get("total_tasks") != len(reader.task_names):
        found = f"total_tasks is {info.get('total_tasks')}"
        yield DataError.at(path, f"{found}, but {schema.TASKS_PATH} lists {len(reader.task_names)}")
    yield from (DataError.at(path, text) for text in _split_problems(info, len(reader)))
    index = 0
    for file in metadata.episode_files(reader.root):
        with data_errors(file):
            listed = open_parquet(file).read(columns=["tasks"])["tasks"].to_pylist()
        for tasks in listed:
            if tasks != [reader.task(index)]:
                problem = f"its tasks are {tasks}, expected {reader.task(index)}"
                yield DataError.at(file, problem, index)
            index += 1


def _split_problems(info: dict[str, Any] | Any, episodes: int) -> Iterator[str]:
    splits = info.get("splits")
    if not isinstance(splits, dict) or not splits:
        yield f"splits is {splits!r}, expected ranges of episodes such as {{'train': '0:9'}}"
        return
    for name, text in splits.items():
        found = _RANGE.fullmatch(text) if isinstance(text, str) else None
        if found is None or not int(found[1]) <= int(found[2]) <= episodes:
            yield f"split {name} is {text!r}, expected a range within 0:{episodes}"
