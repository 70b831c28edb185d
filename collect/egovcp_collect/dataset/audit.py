"""`egovcp-dataset audit`: simulate recorded episodes again and compare them bit for bit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import draccus
import numpy as np
from draccus.utils import DraccusException
from tqdm import tqdm

from egovcp.bounds import bounded
from egovcp.data import DatasetConfig, DatasetReader, Episode, Provenance, schema
from egovcp.data.provenance import source_index, source_provenances
from egovcp.data.source import select_episodes
from egovcp.errors import DataError
from egovcp.outputs import output_file, write_report
from egovcp.sim.robot_env import controller_id_of
from egovcp.sim.scenario import Scenario
from egovcp.terminal import echo
from egovcp_collect.config import EPISODE_OPTIONS, CollectConfig
from egovcp_collect.provenance import installed_versions, migrate_config
from egovcp_collect.simulation import Simulation

_RUN_S = 0.5  # of simulation before finished episodes are yielded


@dataclass(frozen=True)
class AuditConfig:
    """Simulate episodes of a dataset again from the recorded configuration, seed and number, and
    compare them with the recorded ones. Exits with code 3 if one differs."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    episodes: str = ""
    """Which episodes: `[0, 7]`, `0:100` (without 100) or `[0:100, 250]`; empty: --count of them."""
    count: int = bounded(5, least=1)
    """How many episodes, spread evenly over the dataset."""
    json: str = output_file()
    """File for the result: {"ok", "episodes", "different", "versions"}; empty: none."""


def run_audit(config: AuditConfig) -> None:
    """Print whether the episodes are reproduced."""
    reader = DatasetReader.open(config.dataset)
    total = len(reader)
    if config.episodes:
        selected = select_episodes(config.episodes, total, "--episodes")
    else:
        spread = np.linspace(0, total - 1, min(config.count, total)).round()
        selected = np.unique(spread.astype(int))
    episodes = selected.tolist()
    simulated = tqdm(resimulate(reader, episodes), total=len(episodes), unit="ep", delay=1)
    different = sorted(
        index
        for index, episode in simulated
        if episode.digest() != (reader.digest(index) or reader.read(index).digest())
    )
    versions = changed_versions(reader, episodes)
    result = {"ok": not different, "episodes": episodes, "different": different}
    write_report(config.json, {**result, "versions": versions})
    if different:
        changed = "; ".join(f"{name} was {old}, is {new}" for name, (old, new) in versions.items())
        raise DataError(
            f"{reader.root}: episode(s) {', '.join(map(str, different))} came out differently; "
            f"versions: {changed or 'all as recorded, so the machine or the code differs'}"
        )
    echo(f"{reader.root}: {len(episodes)} episodes simulated again, the same bit for bit")


def resimulate(reader: DatasetReader, episodes: Sequence[int]) -> Iterator[tuple[int, Episode]]:
    """Simulate recorded episodes again.

    Args:
        episodes: indices in the dataset.

    Yields:
        Index and content of each episode, in the order in which they end.

    Raises:
        DataError: the configuration of an episode is not recorded, or not supported any more.
    """
    sources = len(source_provenances(reader.origin))
    groups: dict[tuple[int, int], list[int]] = {}
    for index in episodes:
        source = source_index(sources, reader.metadata(index))
        groups.setdefault((source, scenario_of(reader, index).seed), []).append(index)
    for indices in groups.values():
        scenarios = [scenario_of(reader, index) for index in indices]
        index_of = {s.episode: index for s, index in zip(scenarios, indices, strict=True)}
        simulation = Simulation(_recorded_config(reader, indices[0]))
        simulation.add(scenarios)
        while not simulation.idle:
            for number, episode in simulation.run(_RUN_S)[1]:
                yield index_of[number], episode


def scenario_of(reader: DatasetReader, index: int) -> Scenario:
    """The scenario of an episode.

    Raises:
        DataError: its seed or number is not recorded.
    """
    metadata = reader.metadata(index)
    for name in ("seed", "episode"):
        value = metadata.get(name)
        if not isinstance(value, int) or value < 0:
            raise _error(reader, index, f"its {name} is {value!r}, expected a number")
    return Scenario(reader.task(index), metadata["seed"], metadata["episode"])


def changed_versions(reader: DatasetReader, episodes: Sequence[int]) -> dict[str, list[str]]:
    """Package -> [recorded version, installed version], where they differ."""
    installed = installed_versions()
    return {
        name: [version, installed.get(name, "none")]
        for index in episodes
        for name, version in _provenance_of(reader, index).versions.items()
        if installed.get(name) != version
    }


def _recorded_config(reader: DatasetReader, index: int) -> CollectConfig:
    """The configuration that an episode was collected with."""
    recorded = _provenance_of(reader, index).config
    settings = {name: recorded[name] for name in EPISODE_OPTIONS if name in recorded}
    if "env" not in settings:
        raise _error(reader, index, "records no configuration of the simulator to repeat")
    try:
        config: CollectConfig = draccus.decode(CollectConfig, migrate_config(settings))
    except (DraccusException, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        problem = f"its configuration is not one of this version of egovcp: {reason}"
        raise _error(reader, index, problem) from error
    controller = controller_id_of(config.env, config.tasks)
    if controller != reader.controller_id:
        problem = f"controller {reader.controller_id}, but here it is {controller}"
        raise _error(reader, index, problem)
    return config


def _provenance_of(reader: DatasetReader, index: int) -> Provenance:
    """The provenance of one episode of a dataset that may be merged."""
    parts = source_provenances(reader.origin)
    return parts[source_index(len(parts), reader.metadata(index))]


def _error(reader: DatasetReader, index: int, problem: str) -> DataError:
    return DataError.at(reader.root / schema.COLLECTION_PATH, problem, index)
