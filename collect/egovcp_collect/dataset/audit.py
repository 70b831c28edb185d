"""`egovcp-dataset audit`: simulate episodes again and compare them bit for bit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from draccus.utils import DraccusException
from tqdm import tqdm

from egovcp.data import DatasetConfig, DatasetReader, Episode, schema
from egovcp.data.continued import read_provenance
from egovcp.errors import DataError, UsageError
from egovcp.robot.controllers import make_controller
from egovcp.sim.scenario import Scenario
from egovcp_collect.config import SHAPING, CollectConfig
from egovcp_collect.dataset.origin import origin_of, source_of
from egovcp_collect.dataset.replace import write_report
from egovcp_collect.simulation import Simulation
from egovcp_collect.versions import installed_versions

_SLICE = 0.5  # s of simulation between updates of the progress bar


@dataclass(frozen=True)
class AuditConfig:
    """Simulate episodes of a dataset again from the recorded configuration, seed and number, and
    compare them with what it holds. Ends with exit code 3 if one differs."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    episodes: list[int] = field(default_factory=list)
    """Which episodes, [0,7,...]; empty: --count of them."""
    count: int = 5
    """How many episodes, spread evenly over the dataset."""
    json: str = ""
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
    versions = _changed_versions(reader, chosen)
    facts = {"ok": not different, "episodes": chosen, "different": different}
    write_report(config.json, {**facts, "versions": versions})
    if different:
        raise DataError(_verdict(reader.root, different, versions))
    print(f"{reader.root}: {len(chosen)} episodes simulated again, the same bit for bit")


def _chosen(config: AuditConfig, total: int) -> list[int]:
    for index in config.episodes:
        if not 0 <= index < total:
            raise UsageError(f"--episodes: no episode {index}; the dataset has 0 to {total - 1}")
    if config.count < 1:
        raise UsageError(f"--count={config.count}: expected at least 1")
    spread = np.linspace(0, total - 1, min(config.count, total)).round().astype(int)
    return sorted(set(config.episodes or spread.tolist()))


def _different(reader: DatasetReader, chosen: Sequence[int]) -> list[int]:
    """The episodes that come out otherwise than they were recorded, in order."""
    origin = read_provenance(dict(reader.provenance))
    groups: dict[tuple[int, int], list[int]] = {}
    for index in chosen:
        source = source_of(origin, reader.metadata(index))
        groups.setdefault((source, _number(reader, index, "seed")), []).append(index)
    different: list[int] = []
    with tqdm(total=len(chosen), unit="ep", delay=1) as bar:
        for (_, seed), indices in groups.items():
            for index, episode in _simulated(reader, seed, indices):
                if episode.digest() != (reader.digest(index) or reader.read(index).digest()):
                    different.append(index)
                bar.update(1)
    return sorted(different)


def _simulated(
    reader: DatasetReader, seed: int, indices: Sequence[int]
) -> Iterator[tuple[int, Episode]]:
    """Episodes of one collection, in the order in which they end."""
    index_of = {_number(reader, index, "episode"): index for index in indices}
    simulation = Simulation(_collection(reader, indices[0]))
    simulation.add(Scenario(reader.task(i), seed, number) for number, i in index_of.items())
    while not simulation.idle:
        for number, episode in simulation.advance(_SLICE).episodes:
            yield index_of[number], episode


def _number(reader: DatasetReader, index: int, name: str) -> int:
    value = reader.metadata(index).get(name)
    if not isinstance(value, int) or value < 0:
        path = reader.root / schema.COLLECTION_PATH
        raise DataError.at(path, f"its {name} is {value!r}, expected a number", index)
    return value


def _collection(reader: DatasetReader, index: int) -> CollectConfig:
    """The recorded configuration of what shapes an episode.

    Raises:
        DataError: there is none, or this version cannot follow it.
    """
    path = reader.root / schema.COLLECTION_PATH
    origin = origin_of(read_provenance(dict(reader.provenance)), reader.metadata(index))
    settings = {name: origin.config[name] for name in SHAPING if name in origin.config}
    if "env" not in settings:
        raise DataError.at(path, "records no configuration of the simulator to repeat", index)
    try:
        config: CollectConfig = draccus.decode(CollectConfig, settings)
    except (DraccusException, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        problem = f"its configuration is not one of this version of egovcp: {reason}"
        raise DataError.at(path, problem, index) from error
    controller = make_controller(config.env.controller).id
    if controller != reader.controller_id:
        problem = f"controller {reader.controller_id}, but here it is {controller}"
        raise DataError.at(path, problem, index)
    return config


def _changed_versions(reader: DatasetReader, chosen: Sequence[int]) -> dict[str, list[str]]:
    """Package -> [recorded, installed], where they differ."""
    now = installed_versions()
    changed: dict[str, list[str]] = {}
    for recorded in _recorded_versions(reader, chosen):
        for name, version in recorded.items():
            if now.get(name) != version:
                changed[name] = [version, now.get(name, "none")]
    return changed


def _recorded_versions(reader: DatasetReader, chosen: Sequence[int]) -> Iterator[Mapping[str, Any]]:
    for index in chosen:
        yield origin_of(read_provenance(dict(reader.provenance)), reader.metadata(index)).versions


def _verdict(root: Path, different: Sequence[int], versions: Mapping[str, Sequence[str]]) -> str:
    changed = "; ".join(f"{name} was {old}, is {new}" for name, (old, new) in versions.items())
    return (
        f"{root}: episode(s) {', '.join(map(str, different))} came out differently; versions: "
        f"{changed or 'all as recorded, so the machine differs or the code was changed'}"
    )
