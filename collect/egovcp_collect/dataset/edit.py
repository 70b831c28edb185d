"""`egovcp-dataset delete` and `split`: some episodes of a dataset as new datasets."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from egovcp.bounds import bounded
from egovcp.checks.lerobot_dataset import LeRobotCheck
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter
from egovcp.data.destination import require_outside
from egovcp.data.lerobot import LeRobotReader, is_own
from egovcp.data.source import locate, select_episodes
from egovcp.errors import UsageError
from egovcp.files import removed_on_error
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo, echo_lines
from egovcp_collect.dataset.rewrite import new_folder
from egovcp_collect.dataset.subset import write_subset


@dataclass(frozen=True)
class DeleteConfig:
    """Write a dataset without some episodes to a new folder; the old one is not changed.

    Works on LeRobot v3 datasets of any features. Videos are copied, not encoded again."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    episodes: str = ""
    """The episodes to leave out: numbers, `[0, 5, 7]`, a range whose end is excluded, `0:1334`, or
    both, `[0:100, 250]`."""
    output_dir: str = ""
    """Folder of the new dataset."""
    json: str = output_file()
    """File for the result: {"episodes", "frames"}; empty: none."""


@dataclass(frozen=True)
class SplitConfig:
    """Split a dataset at random into several new ones; the old one is not changed.

    Works on LeRobot v3 datasets of any features. Videos are copied, not encoded again."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    splits: dict[str, float] = field(default_factory=lambda: {"train": 0.9, "test": 0.1})
    """NAME: share, for each new dataset; what is left over is in none."""
    seed: int = bounded(0, least=0)
    """Seed of the random choice."""
    output_dir: str = ""
    """Folder of the new datasets, each in a folder with its name."""
    json: str = output_file()
    """File for the result: {NAME: {"episodes", "frames"}}; empty: none."""


def run_delete(config: DeleteConfig) -> None:
    """Write the new dataset."""
    reader, count = _open(config.dataset)
    require_outside(reader.root, config.json)
    if not config.episodes:
        raise UsageError("--episodes is missing; name the episodes to leave out, '[3, 7]'")
    left_out = select_episodes(config.episodes, count, "--episodes").tolist()
    kept = sorted(set(range(count)) - set(left_out))
    if not kept:
        raise UsageError(f"--episodes={config.episodes} leaves no episode of {count}")
    output = new_folder(config.output_dir, [reader.root])
    result = _write(reader, kept, output)
    write_report(config.json, result)
    _print(output, result)


def run_split(config: SplitConfig) -> None:
    """Write the new datasets."""
    reader, count = _open(config.dataset)
    require_outside(reader.root, config.json)
    total = sum(config.splits.values())
    valid_names = all(re.fullmatch(r"\w[\w.-]{0,99}", name, re.ASCII) for name in config.splits)
    valid_shares = all(0 < share <= 1 for share in config.splits.values())
    if not (config.splits and valid_names and valid_shares and total <= 1 + 1e-9):
        raise UsageError(
            f"--splits={config.splits}: expected names of folders with shares that add up to 1 or "
            "less, such as {train: 0.9, test: 0.1}"
        )
    order = np.random.default_rng(config.seed).permutation(count)
    parts, first, share = dict[str, tuple[list[int], Path]](), 0, 0.0
    for name, part in config.splits.items():
        share += part
        end = math.floor(share * count + 0.5)
        if end <= first:
            raise UsageError(f"--splits: {name} would have none of the {count} episodes")
        folder = str(Path(config.output_dir) / name) if config.output_dir else ""
        kept = sorted(order[first:end].tolist())
        parts[name], first = (kept, new_folder(folder, [reader.root])), end
    result = {}
    with ExitStack() as finished:
        for name, (kept, output) in parts.items():
            result[name] = _write(reader, kept, output)
            finished.enter_context(removed_on_error(output))
    write_report(config.json, result)
    for name, (_, output) in parts.items():
        _print(output, result[name])


def _open(config: DatasetConfig) -> tuple[DatasetReader | LeRobotReader, int]:
    """A dataset with valid tables, and its number of episodes; prints what is not checked."""
    source = locate(config)
    if is_own(source.root):
        own = DatasetReader.open_source(source)
        return own, len(own)
    reader = LeRobotReader.open(source.root)
    echo_lines(f"not checked: {note}" for note in LeRobotCheck(reader).notes())
    return reader, len(reader.rows)


def _write(
    reader: DatasetReader | LeRobotReader, kept: Sequence[int], output: Path
) -> dict[str, int]:
    """Write the episodes to the new dataset ``output``."""
    if isinstance(reader, DatasetReader):
        with DatasetWriter(output, reader.origin) as writer:
            for index in tqdm(kept, unit="ep", delay=1):
                writer.add(reader.read(index))
        episodes, frames = len(kept), writer.num_frames
    else:
        episodes, frames = write_subset(reader, kept, output)
    return {"episodes": episodes, "frames": frames}


def _print(output: Path, result: Mapping[str, int]) -> None:
    echo(f"{output}: {result['episodes']} episodes, {result['frames']} frames")
