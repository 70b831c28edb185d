"""`egovcp-dataset merge` and `repair`: write a new dataset from the episodes of others."""

from __future__ import annotations

import itertools
import json
import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from tqdm import tqdm

from egovcp.checks.dataset import command_problems
from egovcp.checks.lerobot_dataset import LeRobotCheck
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Episode, metadata, schema
from egovcp.data.destination import require_new, require_outside, resolve_root
from egovcp.data.lerobot import LeRobotReader, episode_runs, is_own
from egovcp.data.parquet import (
    EPISODE_FEATURES,
    data_errors,
    open_data_file,
    present_columns,
    read_columns,
)
from egovcp.data.paths import files_below
from egovcp.data.provenance import DuplicateFinder, ScenarioKeys
from egovcp.data.reader import mistimed
from egovcp.data.source import Source, local_root, require_folder
from egovcp.data.writer import new_dataset
from egovcp.errors import DataError, UsageError
from egovcp.files import user_path
from egovcp.outputs import output_file, write_report
from egovcp.robot_spec import G1, RobotSpec
from egovcp.terminal import echo, echo_lines, one_line
from egovcp_collect.dataset.check import problem_as_json
from egovcp_collect.dataset.record_index import (
    RecordIndex,
    join_metadata,
    join_provenance,
    require_one_controller,
)
from egovcp_collect.dataset.subset import SubsetWriter, scan_episodes


@dataclass(frozen=True)
class MergeConfig:
    """Write the episodes of several egovcp datasets to one new dataset; the old ones are not
    changed.

    They must have been collected with the same low-level controller. Each episode is verified
    against its recorded SHA-256, and keeps its metadata."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The first dataset."""
    others: list[str] = field(default_factory=list)
    """Folders of the other datasets; they may also follow the first dataset without a flag."""
    output_dir: str = ""
    """Folder of the new dataset."""
    duplicates: Literal["refuse", "drop"] = "refuse"
    """Whether to refuse or drop an episode whose content equals that of an earlier one."""
    json: str = output_file()
    """File for the result: {"episodes", "frames", "duplicates_dropped"}; empty: none."""


@dataclass(frozen=True)
class RepairConfig:
    """Write every readable, valid and unaltered episode to a new dataset, and list the dropped
    ones with reasons. The old dataset is not changed.

    Of a LeRobot v3 dataset that egovcp did not collect, tables, totals and statistics are written
    anew from the rows, and videos are copied as they are.

    LeRobot's own tools (delete_episodes, split_dataset, merge_datasets) drop
    meta/collection.json; --records restores it from the datasets that they were given."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset to repair; a folder."""
    output_dir: str = ""
    """Folder of the new dataset."""
    records: list[str] | str = field(default_factory=list)
    """Datasets that the episodes were taken from, [A, B] or A,B; episodes are matched by the
    SHA-256 of their content."""
    json: str = output_file()
    """File for the result: {"episodes", "frames", "dropped": [{"file", "episode", "frame",
    "problem"}]}; empty: none."""


def run_merge(config: MergeConfig) -> None:
    """Write the new dataset and print what it holds.

    Raises:
        UsageError: fewer than two datasets, or an invalid output folder.
        DataError: a dataset is damaged or has another controller, or an episode occurs twice.
        EnvironmentFailure: the Hub cannot be reached, or the output folder cannot be written.
    """
    if not config.others:
        raise UsageError("merge needs two datasets or more: egovcp-dataset merge A B ...")
    datasets = (config.dataset, *(DatasetConfig(root=other) for other in config.others))
    readers = [DatasetReader.open(dataset) for dataset in datasets]
    output = new_folder(config.output_dir, [reader.root for reader in readers])
    for reader in readers:
        require_outside(reader.root, config.json)
    require_one_controller({reader.root: reader.controller_id for reader in readers})
    chosen, dropped = _distinct_episodes(readers, config.duplicates)
    roots = [str(reader.root) for reader in readers]
    flags = [f"--duplicates={config.duplicates}"] if config.duplicates == "drop" else []
    command = shlex.join(["egovcp-dataset", "merge", *roots, *flags])
    provenances = [reader.origin for reader in readers]
    with DatasetWriter(output, join_provenance(provenances, command)) as writer:
        for source, index in tqdm(chosen, unit="ep", delay=1):
            episode = readers[source].read(index)
            joined = join_metadata(episode.metadata, provenances, source)
            writer.add(replace(episode, metadata=joined))
        frames = writer.num_frames
    result = {"episodes": len(chosen), "frames": frames, "duplicates_dropped": dropped}
    write_report(config.json, result)
    echo(f"{output}: {len(chosen)} episodes, {frames} frames; {dropped} duplicates dropped")


def new_folder(output_dir: str, sources: Sequence[Path]) -> Path:
    """The folder ``--output_dir``.

    Raises:
        UsageError: it is not given, exists and is not empty, or lies inside one of ``sources``.
        EnvironmentFailure: it is a mount point, or cannot be written.
    """
    if not output_dir:
        raise UsageError("--output_dir is missing; name the folder of the new dataset")
    folder = resolve_root(output_dir)
    for source in sources:
        if folder.is_relative_to(source.resolve()):
            raise UsageError(f"--output_dir={output_dir} lies inside {source}; choose another")
    require_new(folder)
    return folder


def _distinct_episodes(
    readers: Sequence[DatasetReader], duplicates: str
) -> tuple[list[tuple[int, int]], int]:
    """(dataset, index) of the episodes to write, and how many duplicates are dropped.

    Raises:
        DataError: an episode equals an earlier one and ``duplicates`` is "refuse", or it has the
            scenario of an earlier one but other content.
    """
    finder = DuplicateFinder[str]()
    distinct, dropped = [], 0
    for source, reader in enumerate(readers):
        for index in range(len(reader)):
            place, scenario = f"{reader.root}, episode {index}", reader.scenario(index)
            digest = reader.digest(index) or reader.read(index).digest()
            duplicate = finder.add(place, digest, scenario)
            if duplicate is None:
                distinct.append((source, index))
            elif not duplicate.equal:
                raise DataError(
                    f"{place} is {scenario}, and so is {duplicate.place}, but their content "
                    "differs: one of them was altered, or collected with changed code of the same "
                    "version; leave out one of the datasets"
                )
            elif duplicates == "refuse":
                raise DataError(
                    f"{place} equals {duplicate.place}; --duplicates=drop keeps the first"
                )
            else:
                dropped += 1
    return distinct, dropped


def run_repair(config: RepairConfig) -> None:
    """Write the new dataset and print the dropped episodes.

    Raises:
        UsageError: no dataset is named, a revision is given, or an invalid output folder.
        DataError: there are no records, an original is damaged, or no episode can be kept.
        EnvironmentFailure: the output folder cannot be written.
    """
    root = local_root(config.dataset)
    require_folder(root)
    output = new_folder(config.output_dir, [root])
    require_outside(root, config.json)
    given = config.records.split(",") if isinstance(config.records, str) else config.records
    originals = [user_path(name).absolute() for name in given if name]
    if not is_own(root) and not originals:
        _repair_other(config, root, output)
        return
    flags = [f"--records={json.dumps([*map(str, originals)])}"] if originals else []
    command = shlex.join(["egovcp-dataset", "repair", str(root), *flags])
    records = RecordIndex.build(root, originals, command)
    robot = _recorded_robot(root)
    assumed = f"; {schema.INFO_PATH} is damaged, so the robot is unknown: the G1 was assumed"
    dropped: list[DataError] = []
    with DatasetWriter(output, records.provenance) as writer:
        episodes = _valid_episodes(root, robot or G1, records, dropped)
        for episode in tqdm(episodes, unit="ep", delay=1):
            writer.add(episode)
        if not writer.num_episodes:
            _report(config, root, writer, dropped, "" if robot else assumed)
    echo(f"{output}: {_report(config, root, writer, dropped)}")


def _repair_other(config: RepairConfig, root: Path, output: Path) -> None:
    """Write the valid episodes of a dataset that egovcp did not collect."""
    reader, dropped, shortened = LeRobotReader(root), list[DataError](), list[str]()
    with new_dataset(output) as folder:
        writer = SubsetWriter(reader, folder)
        for found in scan_episodes(reader):
            if isinstance(found, DataError):
                dropped.append(found)
                continue
            writer.add(found)
            if error := found.length_problem:
                shortened.append(one_line(f"kept: {error}"))
        if not writer.num_episodes:
            _report(config, root, writer, dropped)
        writer.finish()
    echo_lines([*shortened, *(f"not checked: {note}" for note in LeRobotCheck(reader).notes())])
    echo(f"{output}: {_report(config, root, writer, dropped)}")


def _report(
    config: RepairConfig,
    root: Path,
    writer: DatasetWriter | SubsetWriter,
    dropped: list[DataError],
    note: str = "",
) -> str:
    """Print the problems, write the report and return a summary.

    Raises:
        DataError: no episode is kept, with ``note``; the unfinished dataset is removed.
    """
    kept, frames = writer.num_episodes, writer.num_frames
    for error in dropped:
        echo(one_line(f"dropped: {error}"))
    problems = [problem_as_json(error, root) for error in dropped]
    write_report(config.json, {"episodes": kept, "frames": frames, "dropped": problems})
    if not kept:
        count = f"{len(dropped)} problem(s), see above"
        raise DataError(f"no episode of {root} can be kept; {count}{note}")
    lost = len({error.episode for error in dropped} - {None})
    return f"{kept} episodes, {frames} frames; dropped {lost} episodes ({len(dropped)} problems)"


def _recorded_robot(root: Path) -> RobotSpec | None:
    """The robot of a dataset; None if ``info.json`` is damaged."""
    try:
        return metadata.load_robot(metadata.load_v3_info(root), root / schema.INFO_PATH)
    except DataError:
        return None


def _valid_episodes(
    root: Path, robot: RobotSpec, records: RecordIndex, dropped: list[DataError]
) -> Iterator[Episode]:
    """Each valid episode once; the errors of the others are appended to ``dropped``."""
    seen: set[int | None] = set()
    finder, scenarios = DuplicateFinder[int](), ScenarioKeys(records.provenance)
    for found in _read_data_files(root, robot):
        if isinstance(found, DataError):
            dropped.append(found)
            seen.add(found.episode)
            continue
        path, index, episode = found
        seen.add(index)
        try:
            valid = _validated(episode, index, records, scenarios, finder)
        except DataError as error:
            dropped.append(DataError.at(path, error.problem, index, error.frame))
        else:
            yield valid
    dropped += _lost_episodes(root, sorted(set(range(records.recorded)) - seen))


def _lost_episodes(root: Path, indices: Sequence[int]) -> list[DataError]:
    """An error for each of these episodes, with the file that should hold it if `meta` is valid,
    else the data folder."""
    reader: DatasetReader | None = None
    if indices:
        with suppress(DataError):
            reader = DatasetReader(Source(root, ""))
    count = len(reader) if reader else 0
    paths = [reader.data_path(i) if reader and i < count else root / "data" for i in indices]
    return [
        DataError.at(path, "cannot be read", index)
        for path, index in zip(paths, indices, strict=True)
    ]


def _read_data_files(
    root: Path, robot: RobotSpec
) -> Iterator[tuple[Path, int, Episode] | DataError]:
    """File, ``episode_index`` and content of each episode in the data files, and an error for each
    unreadable part; `meta` is not read."""
    for path in files_below(root / "data"):
        if path.suffix == ".parquet":
            try:
                file = open_data_file(root, path, robot)
            except DataError as error:
                yield error
                continue
            names = present_columns(schema.FEATURES, file.schema_arrow.names)
            for found in episode_runs(file, path, names):
                if isinstance(found, DataError):
                    yield found
                    continue
                index, table = found
                try:
                    yield path, index, _assembled(path, table, robot)
                except DataError as error:
                    yield DataError.at(path, error.problem or str(error), index, error.frame)


def _assembled(path: Path, table: pa.Table, robot: RobotSpec) -> Episode:
    """The rows as an episode without task, time limit and metadata, on which its digest does not
    depend."""
    with data_errors(path):
        columns = read_columns(table, schema.FEATURES, robot)
    frames = np.arange(len(table))
    wrong_time = mistimed(columns["timestamp"], robot.planner_hz)
    wrong = (columns["frame_index"] != frames) | wrong_time
    if wrong.any():
        problem = f"its frame indices or timestamps do not count at {robot.planner_hz} Hz from 0"
        raise DataError.without_place(problem, int(np.argmax(wrong)))
    arrays: dict[str, Any] = {name: columns[key] for name, key in EPISODE_FEATURES.items()}
    return Episode(**arrays, task="", time_limit=0, robot=robot)


def _validated(
    found: Episode,
    index: int,
    records: RecordIndex,
    scenarios: ScenarioKeys,
    finder: DuplicateFinder[int],
) -> Episode:
    """The episode with its record; raises `DataError` with its first problem."""
    digest = found.digest()
    record = records.find(digest, index)
    if record is None:
        raise DataError.without_place(
            "its content is in no record (meta/collection.json, --records): it was altered, or "
            "comes from another dataset"
        )
    episode = replace(
        found,
        task=record["task"],
        time_limit=record["time_limit"],
        metadata=record.get("metadata", {}),
    )
    for frame, problem in itertools.chain(episode.problems(), command_problems(episode)):
        raise DataError.without_place(problem, frame)
    scenario = scenarios.key(episode.task, episode.metadata)
    duplicate = finder.add(index, digest, scenario)
    if duplicate is not None:
        raise DataError.without_place(duplicate.problem(scenario))
    return episode
