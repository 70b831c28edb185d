"""`egovcp-dataset repair`: a sound dataset out of whatever can still be read of one."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from egovcp.checks.dataset import command_problems
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Episode
from egovcp.data.provenance import DuplicateFinder, ScenarioKeys
from egovcp.data.source import Source, local_root, require_folder
from egovcp.errors import DataError
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo, one_line
from egovcp_collect.dataset.book import Book, open_book
from egovcp_collect.dataset.check import as_json
from egovcp_collect.dataset.output import new_folder
from egovcp_collect.dataset.salvage import Found, salvage


@dataclass(frozen=True)
class RepairConfig:
    """Write a new dataset of every episode that is readable, valid and as it was collected, and
    say which were dropped and why. The old one is only read.

    The facts that LeRobot's own tools drop (delete_episodes, split_dataset, merge_datasets keep no
    meta/collection.json) come back from the datasets that they were given: --records."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset to repair; a folder."""
    output_dir: str = ""
    """Folder of the new dataset."""
    records: str = ""
    """Datasets that the episodes were taken from, separated by commas; an episode is found among
    theirs by the SHA-256 of its content."""
    json: str = output_file()
    """File for the result: {"episodes", "frames", "dropped": [{"file", "episode", "frame",
    "problem"}]}; empty: none."""


CONFIG = RepairConfig


def run(config: RepairConfig) -> None:
    """Write the new dataset and print what was dropped.

    Raises:
        UsageError: the new folder exists, or lies in the old one.
        DataError: nothing can be kept, or nobody knows where the episodes came from.
    """
    root = local_root(config.dataset)
    require_folder(root)
    output = new_folder(config.output_dir, [root])
    originals = _originals(config)
    book = open_book(root, originals, _command(root, originals))
    dropped: list[DataError] = []
    with tqdm(unit="ep", delay=1) as bar:
        kept, frames = _rebuild(root, book, output, dropped, bar)
    for error in dropped:
        echo(one_line(f"dropped: {error}"))
    facts = {"episodes": kept, "frames": frames}
    problems = [as_json(error, root) for error in dropped]
    write_report(config.json, {**facts, "dropped": problems})
    if not kept:
        raise DataError(f"nothing of {root} can be kept; {len(dropped)} problem(s), see above")
    echo(f"{output}: {kept} episodes, {frames} frames; {len(dropped)} problem(s) left behind")


def _command(root: Path, originals: list[Path]) -> str:
    records = ",".join(map(str, originals))
    flags = [f"--records={records}"] if records else []
    return shlex.join(["egovcp-dataset", "repair", str(root), *flags])


def _originals(config: RepairConfig) -> list[Path]:
    named = [os.path.expanduser(name) for name in config.records.split(",") if name]
    return [Path(name).absolute() for name in named]


def _rebuild(
    root: Path, book: Book, output: Path, dropped: list[DataError], bar: Any
) -> tuple[int, int]:
    """Write what can be kept; episodes and frames."""
    writer = DatasetWriter(output, book.provenance)
    try:
        for episode in _sound_episodes(root, book, dropped):
            writer.add(episode)
            bar.update(1)
    except BaseException:
        writer.discard()
        raise
    kept, frames = writer.num_episodes, writer.num_frames
    writer.finalize() if kept else writer.discard()
    return kept, frames


def _sound_episodes(root: Path, book: Book, dropped: list[DataError]) -> Iterator[Episode]:
    """Each episode once; why others are left behind goes to ``dropped``."""
    seen: set[int] = set()
    finder, scenarios = DuplicateFinder[int](), ScenarioKeys(book.provenance)
    for found in salvage(root):
        if isinstance(found, DataError):
            dropped.append(found)
            seen |= {found.episode} if found.episode is not None else set()
            continue
        seen.add(found.number)
        digest = found.digest()
        record = book.find(digest, found.number)
        problems = list(_problems(found, record))
        if not problems and record is not None:
            problems = list(_repetition(found.number, digest, record, scenarios, finder))
        if problems or record is None:
            frame, problem = problems[0]
            dropped.append(DataError.at(found.file, problem, found.number, frame))
        else:
            yield found.episode(dict(record))
    for number in sorted(set(range(book.own)) - seen):
        dropped.append(DataError.at(_place(root, number), "cannot be read", number))


def _repetition(
    number: int,
    digest: str,
    record: Mapping[str, Any],
    scenarios: ScenarioKeys,
    finder: DuplicateFinder[int],
) -> Iterator[tuple[int | None, str]]:
    """The problem of an episode that repeats an earlier one, or names no collection."""
    try:
        scenario = scenarios.key(record["task"], record.get("metadata", {}))
    except DataError as error:
        yield None, error.problem
        return
    found = finder.add(number, digest, scenario)
    if found is not None:
        yield None, found.problem(scenario)


def _place(root: Path, number: int) -> Path:
    """The file that should hold an episode, as far as that is known."""
    try:
        return DatasetReader(Source(root, "")).data_path(number)
    except (DataError, IndexError):
        return root / "data"


def _problems(
    found: Found, record: dict[str, Any] | Any | None
) -> Iterator[tuple[int | None, str]]:
    if record is None:
        yield (
            None,
            "its content is in no record (meta/collection.json, --records): it was altered, or "
            "comes from another dataset",
        )
        return
    episode = found.episode(dict(record))
    problems = list(episode.problems())
    yield from problems or command_problems(episode)
