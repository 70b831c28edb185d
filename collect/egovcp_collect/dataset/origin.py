"""How the episodes of one or several datasets came to be, as one provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from egovcp.data import Provenance, schema
from egovcp.errors import DataError

#: Where a joint provenance keeps those it was made of, and an episode says which is its own.
SOURCES: Final = "sources"
SOURCE: Final = "source"


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
    if all(_shape(origin) == _shape(first) for origin in origins):
        return first
    parts = [part for origin in origins for part in parts_of(origin)]
    return Provenance(
        controller_id=first.controller_id,
        seed=None,
        command=command,
        versions={k: v for k, v in first.versions.items() if _agreed(origins, k, v)},
        config={SOURCES: [asdict(part) for part in parts]},
    )


def parts_of(origin: Provenance) -> list[Provenance]:
    """The provenances that a joint one was made of, or itself.

    Raises:
        DataError: they are damaged.
    """
    parts = origin.config.get(SOURCES, [])
    try:
        return [Provenance(**part) for part in parts] or [origin]
    except TypeError as error:
        raise DataError(f"{schema.COLLECTION_PATH}: config.{SOURCES} is damaged") from error


def origin_of(origin: Provenance, facts: Mapping[str, Any]) -> Provenance:
    """The provenance of an episode with these ``metadata``."""
    return parts_of(origin)[source_of(origin, facts)]


def source_of(origin: Provenance, facts: Mapping[str, Any]) -> int:
    """Which of `parts_of` an episode with these ``metadata`` comes from.

    Raises:
        DataError: none of them.
    """
    source, count = facts.get(SOURCE, 0), len(parts_of(origin))
    if not isinstance(source, int) or not 0 <= source < count:
        raise DataError(
            f"{schema.COLLECTION_PATH}: an episode's {SOURCE} is {source!r}, expected 0 to "
            f"{count - 1}"
        )
    return source


def moved(facts: Mapping[str, Any], origins: Sequence[Provenance], index: int) -> dict[str, Any]:
    """An episode's ``metadata`` in the `joint` of ``origins``, of which its own is ``index``."""
    if all(_shape(origin) == _shape(origins[0]) for origin in origins):
        return dict(facts)
    before = sum(len(parts_of(origin)) for origin in origins[:index])
    return {**facts, SOURCE: before + source_of(origins[index], facts)}


def _shape(origin: Provenance) -> Provenance:
    """What an episode depends on; the command that asked for it is not among it."""
    return replace(origin, command="")


def _agreed(origins: Sequence[Provenance], name: str, version: str) -> bool:
    return all(origin.versions.get(name) == version for origin in origins)
