"""How the episodes of one or several datasets came to be, as one provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from egovcp.data import Provenance
from egovcp.data.provenance import SOURCE, SOURCES, source_index, source_provenances
from egovcp.errors import DataError


def require_one_controller(controllers: Mapping[Path, str]) -> None:
    """Raise `DataError` unless the datasets were all collected with the same controller."""
    (first, expected), *others = controllers.items()
    for root, found in others:
        if found != expected:
            raise DataError(
                f"{root} was collected with low-level controller {found}, {first} with {expected}; "
                "what an action does differs, and such episodes do not mix"
            )


def joint(origins: Sequence[Provenance], command: str) -> Provenance:
    """One provenance for episodes of several; each of them says which is its own.

    If all agree on what shapes an episode, they are one already.
    """
    first = origins[0]
    if all(without_command(origin) == without_command(first) for origin in origins):
        return first
    parts = [part for origin in origins for part in source_provenances(origin)]
    return Provenance(
        controller_id=first.controller_id,
        seed=None,
        command=command,
        versions={k: v for k, v in first.versions.items() if _agreed(origins, k, v)},
        config={SOURCES: [asdict(part) for part in parts]},
    )


def moved(facts: Mapping[str, Any], origins: Sequence[Provenance], index: int) -> dict[str, Any]:
    """An episode's ``metadata`` in the `joint` of ``origins``, of which its own is ``index``."""
    if all(without_command(origin) == without_command(origins[0]) for origin in origins):
        return dict(facts)
    before = sum(len(source_provenances(origin)) for origin in origins[:index])
    return {**facts, SOURCE: before + source_index(len(source_provenances(origins[index])), facts)}


def without_command(origin: Provenance) -> Provenance:
    """The provenance without its command, on which no episode depends."""
    return replace(origin, command="")


def _agreed(origins: Sequence[Provenance], name: str, version: str) -> bool:
    return all(origin.versions.get(name) == version for origin in origins)
