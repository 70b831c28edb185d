"""Which collection an episode of a merged dataset comes from, and which scenario it is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from egovcp.data import schema
from egovcp.data.provenance import Provenance, parse_provenance
from egovcp.errors import DataError

#: Key in the configuration of a merged provenance: those that it was made of.
SOURCES: Final = "sources"
#: Key in the metadata of an episode: which of them is its own.
SOURCE: Final = "source"


def parts_of(origin: Provenance) -> list[Provenance]:
    """The provenances that a merged one was made of, or itself.

    Raises:
        DataError: they are damaged.
    """
    parts = origin.config.get(SOURCES, [])
    if not isinstance(parts, list):
        raise DataError.at(schema.COLLECTION_PATH, f"config.{SOURCES} is no list")
    return [
        parse_provenance(part, schema.COLLECTION_PATH, f"config.{SOURCES}[{i}]: ")
        for i, part in enumerate(parts)
    ] or [origin]


def source_of(count: int, facts: Mapping[str, Any]) -> int:
    """Which of ``count`` `parts_of` an episode with these ``metadata`` comes from.

    Raises:
        DataError: none of them.
    """
    source = facts.get(SOURCE, 0)
    if not isinstance(source, int) or isinstance(source, bool) or not 0 <= source < count:
        problem = f"its {SOURCE} is {source!r}, expected 0 to {count - 1}"
        raise DataError.at(schema.COLLECTION_PATH, problem)
    return source


@dataclass(frozen=True)
class ScenarioKey:
    """Two collected episodes with equal keys simulate the same scenario."""

    provenance: str
    """JSON of the controller, versions and configuration."""
    task: str
    seed: str
    number: str

    def __str__(self) -> str:
        return f"{self.task}/{self.seed}/{self.number} (task/seed/number)"


def _shaping(origin: Provenance) -> dict[str, Any]:
    """What a scenario depends on besides task, seed and number."""
    settings = asdict(replace(origin, command="", seed=None))
    env = settings["config"].get("env")
    if isinstance(env, dict):  # the controller may be named by a path; its id says which it is
        settings["config"]["env"] = {k: v for k, v in env.items() if k != "controller"}
    return settings


class ScenarioKeys:
    """Makes the `ScenarioKey` of the episodes of a dataset."""

    def __init__(self, origin: Provenance) -> None:
        """Keys for episodes of this provenance.

        Raises:
            DataError: it is damaged.
        """
        self._parts = parts_of(origin)
        self._texts = [json.dumps(_shaping(part), sort_keys=True) for part in self._parts]

    def key(self, task: str, facts: Mapping[str, Any]) -> ScenarioKey | None:
        """The key of an episode; None if it was not collected by number: a recorded rollout.

        Raises:
            DataError: ``facts`` names a collection that is not recorded.
        """
        if "episode" not in facts:
            return None
        source = source_of(len(self._parts), facts)
        seed = facts.get("seed", self._parts[source].seed)
        return ScenarioKey(self._texts[source], task, str(seed), str(facts["episode"]))
