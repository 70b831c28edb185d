"""May a collection go on where another stopped?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from egovcp.data import Provenance
from egovcp.errors import UsageError
from egovcp_collect.older import completed

_SHOWN: Final = 5


def require_same(now: Provenance, before: Provenance) -> None:
    """Raise `UsageError` unless episode i of one is episode i of the other, for every i."""
    what = {
        "--seed": (before.seed, now.seed),
        "low-level controller": (before.controller_id, now.controller_id),
        **dict(_differences("--", completed(before.config), now.config)),
        **dict(_differences("version of ", before.versions, now.versions)),
    }
    changed = [
        f"{name} was {old}, is {new}"
        for name, (old, new) in what.items()
        # a file of another name may be the same controller: its id is compared
        if name != "--env.controller" and _plain(old) != _plain(new)
    ]
    if changed:
        more = f", and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else ""
        raise UsageError(
            f"--resume cannot go on with other episodes: {'; '.join(changed[:_SHOWN])}{more}; use "
            "what was used before, or another --dataset.root"
        )


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
