"""`egovcp-dataset audit`: simulate episodes again and compare them bit for bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from egovcp.bounds import bounded
from egovcp.data import DatasetConfig, DatasetReader
from egovcp.data.source import select_episodes
from egovcp.errors import DataError
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo
from egovcp_collect.dataset.again import changed_versions, simulated_again


@dataclass(frozen=True)
class AuditConfig:
    """Simulate episodes of a dataset again from the recorded configuration, seed and number, and
    compare them with what it holds. Ends with exit code 3 if one differs."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    episodes: str = ""
    """Which episodes: numbers, `[0, 7]`, a range whose end is excluded, `0:100`, or both; empty:
    --count of them."""
    count: int = bounded(5, least=1)
    """How many episodes, spread evenly over the dataset."""
    json: str = output_file()
    """File for the result: {"ok", "episodes", "different", "versions"}; empty: none."""


CONFIG = AuditConfig


def run(config: AuditConfig) -> None:
    """Print which episodes came out the same.

    Raises:
        UsageError: no such episode.
        DataError: an episode differs, or it is not recorded how it came to be.
    """
    reader = DatasetReader.open(config.dataset)
    chosen = _chosen(config, len(reader))
    different = _different(reader, chosen)
    versions = changed_versions(reader, chosen)
    facts = {"ok": not different, "episodes": chosen, "different": different}
    write_report(config.json, {**facts, "versions": versions})
    if different:
        raise DataError(_verdict(reader.root, different, versions))
    echo(f"{reader.root}: {len(chosen)} episodes simulated again, the same bit for bit")


def _chosen(config: AuditConfig, total: int) -> list[int]:
    if config.episodes:
        return [int(index) for index in select_episodes(config.episodes, total, "--episodes")]
    spread = np.linspace(0, total - 1, min(config.count, total)).round().astype(int)
    return sorted(set(spread.tolist()))


def _different(reader: DatasetReader, chosen: Sequence[int]) -> list[int]:
    """The episodes that come out otherwise than they were recorded, in order."""
    different: list[int] = []
    with tqdm(total=len(chosen), unit="ep", delay=1) as bar:
        for index, episode in simulated_again(reader, chosen):
            if episode.digest() != (reader.digest(index) or reader.read(index).digest()):
                different.append(index)
            bar.update(1)
    return sorted(different)


def _verdict(root: Path, different: Sequence[int], versions: Mapping[str, Sequence[str]]) -> str:
    changed = "; ".join(f"{name} was {old}, is {new}" for name, (old, new) in versions.items())
    return (
        f"{root}: episode(s) {', '.join(map(str, different))} came out differently; versions: "
        f"{changed or 'all as recorded, so the machine differs or the code was changed'}"
    )
