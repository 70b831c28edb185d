"""May a collection go on where another stopped?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from egovcp.data import Provenance
from egovcp.errors import UsageError
from egovcp.spec import TASKS
from egovcp_collect.config import ALL_TASKS
from egovcp_collect.older import completed

_SHOWN: Final = 5


def require_same(now: Provenance, before: Provenance) -> None:
    """Raise `UsageError` unless episode i of one is episode i of the other, for every i."""
    if before.seed is None:  # `egovcp-collect` always records one
        raise UsageError(
            "--resume continues what egovcp-collect has begun, and this dataset was merged or "
            "converted; collect into another --dataset.root, then join both with "
            "`egovcp-dataset merge`"
        )
    changed = {
        name: f"{name} was {old}, is {new}"
        for name, (old, new) in _settings(before, now).items()
        # a file of another name may be the same controller: its id is compared
        if name != "--env.controller" and _plain(old) != _plain(new)
    }
    unused = _unused_prefixes(before, now)
    used = [words for name, words in changed.items() if not name.startswith(unused)]
    shown = used or list(changed.values())
    if shown:
        more = f", and {len(shown) - _SHOWN} more" if len(shown) > _SHOWN else ""
        raise UsageError(
            f"--resume cannot go on with other episodes: {'; '.join(shown[:_SHOWN])}{more}; use "
            "what was used before, or another --dataset.root"
        )


def _settings(before: Provenance, now: Provenance) -> dict[str, tuple[Any, Any]]:
    """Everything that an episode depends on, old and new."""
    return {
        "--seed": (before.seed, now.seed),
        "low-level controller": (before.controller_id, now.controller_id),
        **dict(_differences("--", completed(before.config), now.config)),
        **dict(_differences("version of ", before.versions, now.versions)),
    }


def _unused_prefixes(*collections: Provenance) -> tuple[str, ...]:
    """Options of tasks that none of the collections has."""
    tasks = {collection.config.get("task") for collection in collections}
    if ALL_TASKS in tasks:
        return ()
    unused = [task for task in TASKS if task not in tasks]
    return ("--mix.", *(f"--env.{task}{end}" for task in unused for end in (".", "_episode.")))


def _differences(
    prefix: str, before: Mapping[str, Any], now: Mapping[str, Any]
) -> Iterator[tuple[str, tuple[Any, Any]]]:
    """The leaves of nested settings, old and new."""
    for name in {**before, **now}:
        old, new = before.get(name), now.get(name)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _differences(f"{prefix}{name}.", old, new)
        else:
            yield f"{prefix}{name}", (old, new)


def _plain(value: object) -> object:
    """Pairs as JSON gives them back."""
    return list(value) if isinstance(value, tuple) else value
