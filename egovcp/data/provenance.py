"""How episodes were collected, and which of them occur twice."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from egovcp.data import schema
from egovcp.decode import DecodeError, require_type
from egovcp.errors import DataError


@dataclass(frozen=True)
class Provenance:
    """How a dataset was collected; stored in ``meta/collection.json``."""

    controller_id: str
    """Low-level controller that turned the actions into joint targets."""
    seed: int | None = None
    """Seed of the collection."""
    command: str = ""
    """Command line that repeats the collection."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Installed version of each package on which the data depends."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """Complete configuration of the simulator and the behaviour policy."""
    origin: str = ""
    """``simulated``, ``recorded`` (rollouts) or ``converted`` (another LeRobot dataset); empty:
    unknown, as in datasets of earlier versions."""


def parse_provenance(content: object, path: str | Path, where: str = "") -> Provenance:
    """Parse the provenance in a JSON object; unknown entries are ignored.

    ``path`` and ``where``, such as ``"config.sources[0]: "``, name the place in messages.

    Raises:
        DataError: an entry is missing or of another type.
    """
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise DataError.at(path, f"{where}holds a {kind}, expected an object")
    if not isinstance(content.get("controller_id"), str) or not content["controller_id"]:
        raise DataError.at(path, f"{where}names no low-level controller")
    types = {"seed": int | None, "command": str, "config": dict, "versions": dict, "origin": str}
    for key, expected in types.items():
        value = content.get(key)
        if key in content and (isinstance(value, bool) or not isinstance(value, expected)):
            found, kind = type(value).__name__, getattr(expected, "__name__", str(expected))
            raise DataError.at(path, f"{where}its {key} is a {found}, expected {kind}")
    if not all(isinstance(version, str) for version in content.get("versions", {}).values()):
        raise DataError.at(path, f"{where}its versions are not strings")
    config = content.get("config", {})
    try:
        require_type(env := config.get("env", {}), dict[str, Any], "config.env")
        require_type(env.get("camera", {}), dict[str, Any], "config.env.camera")
        require_type(config.get("step_ticks", [1, 1]), tuple[int, int], "config.step_ticks")
        require_type(config.get("boundary", ""), str, "config.boundary")
    except DecodeError as error:
        raise DataError.at(path, f"{where}{error}") from error
    names = [field.name for field in fields(Provenance)]
    return Provenance(**{key: content[key] for key in names if key in content})


#: Key in the configuration of a merged dataset: the provenances of the merged datasets.
SOURCES: Final = "sources"
#: Key in the metadata of an episode: index of its provenance in `SOURCES`.
SOURCE: Final = "source"


def source_provenances(origin: Provenance) -> list[Provenance]:
    """The provenances of the datasets that were merged; of another dataset its own."""
    parts = origin.config.get(SOURCES, [])
    if not isinstance(parts, list):
        raise DataError.at(schema.COLLECTION_PATH, f"config.{SOURCES} is not a list")
    return [
        parse_provenance(part, schema.COLLECTION_PATH, f"config.{SOURCES}[{i}]: ")
        for i, part in enumerate(parts)
    ] or [origin]


def source_index(count: int, facts: Mapping[str, Any]) -> int:
    """Index among ``count`` `source_provenances` of an episode with metadata ``facts``."""
    source = facts.get(SOURCE, 0)
    if not isinstance(source, int) or isinstance(source, bool) or not 0 <= source < count:
        problem = f"its {SOURCE} is {source!r}, expected 0 to {count - 1}"
        raise DataError.at(schema.COLLECTION_PATH, problem)
    return source


class ScenarioKey(NamedTuple):
    """Two collected episodes with equal keys simulate the same scenario."""

    provenance: str  # JSON of the controller, versions and configuration
    task: str
    seed: str
    number: str

    def __str__(self) -> str:
        return f"{self.task}/{self.seed}/{self.number} (task/seed/number)"


def _scenario_settings(origin: Provenance) -> str:
    """JSON of the settings on which a scenario depends besides task, seed and number."""
    settings = asdict(replace(origin, command="", seed=None, origin=""))
    env = settings["config"].get("env")
    if isinstance(env, dict):  # may name the controller by a path; controller_id identifies it
        settings["config"]["env"] = {k: v for k, v in env.items() if k != "controller"}
    return json.dumps(settings, sort_keys=True)


class ScenarioKeys:
    """Computes the `ScenarioKey` of each episode of a dataset."""

    def __init__(self, origin: Provenance) -> None:
        """Raises `DataError` if ``origin`` is damaged."""
        self._parts = source_provenances(origin)
        self._settings = list(map(_scenario_settings, self._parts))

    def key(self, task: str, facts: Mapping[str, Any]) -> ScenarioKey | None:
        """The key of an episode; None if it has no number, as a recorded rollout."""
        if "episode" not in facts:
            return None
        source = source_index(len(self._parts), facts)
        seed = facts.get("seed", self._parts[source].seed)
        return ScenarioKey(self._settings[source], task, str(seed), str(facts["episode"]))


class Duplicate[P](NamedTuple):
    """An earlier episode that is repeated by a later one.

    If its content is not ``equal``, seed, number and provenance are: one of the two was altered, or
    collected with changed code of the same version.
    """

    place: P
    equal: bool

    def problem(self, scenario: ScenarioKey | None) -> str:
        """Description of the problem of the later episode, which simulates ``scenario``."""
        if self.equal:
            return f"repeats episode {self.place}"
        return f"is {scenario}, as episode {self.place}, but its content differs"


class DuplicateFinder[P]:
    """Finds repeated episodes; ``P`` is the type of a place."""

    def __init__(self) -> None:
        self._by_digest: dict[str, P] = {}
        self._by_scenario: dict[ScenarioKey, P] = {}

    def add(self, place: P, digest: str, scenario: ScenarioKey | None) -> Duplicate[P] | None:
        """Add an episode with its `Episode.digest`; returns the earlier one that it repeats."""
        if digest in self._by_digest:
            return Duplicate(self._by_digest[digest], equal=True)
        self._by_digest[digest] = place
        if scenario is None:
            return None
        if scenario in self._by_scenario:
            return Duplicate(self._by_scenario[scenario], equal=False)
        self._by_scenario[scenario] = place
        return None
