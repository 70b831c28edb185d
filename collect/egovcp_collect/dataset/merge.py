"""`egovcp-dataset merge`: one dataset out of several."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

from tqdm import tqdm

from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter
from egovcp.data.provenance import Duplicate, DuplicateFinder
from egovcp.errors import DataError, UsageError
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo
from egovcp_collect.dataset.origin import joint, moved, require_one_controller
from egovcp_collect.dataset.output import new_folder


@dataclass(frozen=True)
class MergeConfig:
    """Write the episodes of several datasets as one new dataset; the old ones are only read.

    They must have been collected with the same low-level controller. Each episode is compared with
    the SHA-256 that was recorded when it was collected, and keeps the facts of its collection."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The first dataset."""
    others: list[str] = field(default_factory=list)
    """Folders of the others; also those that follow the first without a flag."""
    output_dir: str = ""
    """Folder of the new dataset."""
    duplicates: Literal["refuse", "drop"] = "refuse"
    """What to do about an episode whose content equals that of an earlier one."""
    json: str = output_file()
    """File for the result: {"episodes", "frames", "dropped"}; empty: none."""


CONFIG = MergeConfig
MORE: Final = "others"


def run(config: MergeConfig) -> None:
    """Write the new dataset and print what it holds.

    Raises:
        UsageError: fewer than two datasets, or a bad output folder.
        DataError: they do not mix, share episodes, or are damaged.
    """
    if not config.others:
        raise UsageError("merge needs two datasets or more: egovcp-dataset merge A B ...")
    roots = [DatasetConfig(root=other) for other in config.others]
    readers = [DatasetReader.open(place) for place in (config.dataset, *roots)]
    output = new_folder(config.output_dir, [reader.root for reader in readers])
    require_one_controller({reader.root: reader.controller_id for reader in readers})
    chosen, dropped = _chosen(readers, config.duplicates)
    command = shlex.join(["egovcp-dataset", "merge", *(str(reader.root) for reader in readers)])
    frames = _write(readers, chosen, output, command)
    facts = {"episodes": len(chosen), "frames": frames, "dropped": dropped}
    write_report(config.json, facts)
    echo(f"{output}: {len(chosen)} episodes, {frames} frames; {dropped} duplicates dropped")


def _chosen(readers: Sequence[DatasetReader], duplicates: str) -> tuple[list[tuple[int, int]], int]:
    """(dataset, episode) of each episode to write, and how many repeat an earlier one.

    Raises:
        DataError: an episode repeats an earlier one and must not, or has its seed and number but
            other content.
    """
    finder = DuplicateFinder[tuple[int, int]]()
    episodes = [(number, index) for number, r in enumerate(readers) for index in range(len(r))]
    chosen = []
    for number, index in episodes:
        reader = readers[number]
        digest = reader.digest(index) or reader.read(index).digest()
        found = finder.add((number, index), digest, reader.scenario(index))
        if found is None:
            chosen.append((number, index))
        elif not found.equal or duplicates == "refuse":
            raise _refusal(readers, (number, index), found)
    return chosen, len(episodes) - len(chosen)


def _refusal(
    readers: Sequence[DatasetReader], place: tuple[int, int], found: Duplicate[tuple[int, int]]
) -> DataError:
    (number, index), (earlier, before) = place, found.place
    this = f"{readers[number].root}, episode {index}"
    other = f"{readers[earlier].root}, episode {before}"
    if found.equal:
        return DataError(f"{this} equals {other}; --duplicates=drop keeps the first")
    return DataError(
        f"{this} is {readers[number].scenario(index)}, and so is {other}, but their content "
        "differs: one was altered, or simulated on another machine; leave out one of the datasets"
    )


def _write(
    readers: Sequence[DatasetReader], chosen: Sequence[tuple[int, int]], output: Path, command: str
) -> int:
    origins = [reader.origin for reader in readers]
    with DatasetWriter(output, joint(origins, command)) as writer:
        for number, index in tqdm(chosen, unit="ep", delay=1):
            episode = readers[number].read(index)
            facts: dict[str, Any] = moved(episode.metadata, origins, number)
            writer.add(replace(episode, metadata=facts))
        return writer.num_frames
