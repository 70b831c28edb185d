"""Recorded episodes, simulated again from their configuration, seed and number."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import draccus
from draccus.utils import DraccusException

from egovcp.data import DatasetReader, Episode, Provenance, schema
from egovcp.data.provenance import source_index, source_provenances
from egovcp.errors import DataError
from egovcp.robot.controllers import make_controller
from egovcp.sim.scenario import Scenario
from egovcp_collect.config import SHAPING, CollectConfig
from egovcp_collect.older import completed
from egovcp_collect.simulation import Simulation, Watch
from egovcp_collect.versions import installed_versions

_SLICE = 0.5  # s of simulation between looks at what has ended


def simulated_again(
    reader: DatasetReader,
    chosen: Sequence[int],
    watch: Watch | None = None,
    pictures: bool = True,
) -> Iterator[tuple[int, Episode]]:
    """The chosen episodes of a dataset with their indices, in the order in which they end.

    Args:
        reader: the dataset.
        chosen: indices of episodes.
        watch: shown the robots before each tick (see `Simulation`); a robot's scenario tells
            which episode it plays.
        pictures: false: depth stays empty, all else is the same.

    Raises:
        DataError: it is not recorded how an episode came to be, or this version cannot follow it.
    """
    sources = len(source_provenances(reader.origin))
    groups: dict[tuple[int, int], list[int]] = {}
    for index in chosen:
        source = source_index(sources, reader.metadata(index))
        groups.setdefault((source, _number(reader, index, "seed")), []).append(index)
    for indices in groups.values():
        simulation = Simulation(_collection(reader, indices[0]), watch, pictures)
        yield from _simulated(simulation, {scenario_of(reader, i): i for i in indices})


def scenario_of(reader: DatasetReader, index: int) -> Scenario:
    """What names an episode.

    Raises:
        DataError: its seed or number is not recorded.
    """
    seed, number = (_number(reader, index, name) for name in ("seed", "episode"))
    return Scenario(reader.task(index), seed, number)


def changed_versions(reader: DatasetReader, chosen: Sequence[int]) -> dict[str, list[str]]:
    """Package -> [recorded, installed], where they differ."""
    now = installed_versions()
    changed: dict[str, list[str]] = {}
    for recorded in _recorded_versions(reader, chosen):
        for name, version in recorded.items():
            if now.get(name) != version:
                changed[name] = [version, now.get(name, "none")]
    return changed


def _simulated(
    simulation: Simulation, index_of: Mapping[Scenario, int]
) -> Iterator[tuple[int, Episode]]:
    """Episodes of one collection, in the order in which they end."""
    index_by_number = {scenario.episode: index for scenario, index in index_of.items()}
    simulation.add(index_of)
    while not simulation.idle:
        for number, episode in simulation.advance(_SLICE).episodes:
            yield index_by_number[number], episode


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
    origin = _origin(reader, index, source_provenances(reader.origin))
    settings = {name: origin.config[name] for name in SHAPING if name in origin.config}
    if "env" not in settings:
        raise DataError.at(path, "records no configuration of the simulator to repeat", index)
    try:
        config: CollectConfig = draccus.decode(CollectConfig, completed(settings))
    except (DraccusException, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        problem = f"its configuration is not one of this version of egovcp: {reason}"
        raise DataError.at(path, problem, index) from error
    controller = make_controller(config.env.controller).id
    if controller != reader.controller_id:
        problem = f"controller {reader.controller_id}, but here it is {controller}"
        raise DataError.at(path, problem, index)
    return config


def _origin(reader: DatasetReader, index: int, parts: Sequence[Provenance]) -> Provenance:
    """That of ``parts`` which an episode comes from."""
    try:
        return parts[source_index(len(parts), reader.metadata(index))]
    except DataError as error:
        raise DataError.at(reader.root / schema.COLLECTION_PATH, error.problem, index) from error


def _recorded_versions(reader: DatasetReader, chosen: Sequence[int]) -> Iterator[Mapping[str, Any]]:
    parts = source_provenances(reader.origin)
    for index in chosen:
        yield _origin(reader, index, parts).versions
