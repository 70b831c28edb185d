"""Settings of a dataset that is older than some of the options."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import draccus

from egovcp_collect.config import ALL_TASKS, SHAPING, CollectConfig

#: Task -> what was done in it before an option was there, if that is not its default: nothing was
#: paid for a guard at the wall until November 2026.
_BEFORE: Final[Mapping[str, Any]] = {"wall": {"env": {"wall": {"guard_cost": 0.0}}}}


def completed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Recorded settings of what shapes an episode, with those that were not options yet as they
    were then."""
    defaults = draccus.encode(CollectConfig())
    found: Mapping[str, Any] = {name: defaults[name] for name in SHAPING}
    for task, before in _BEFORE.items():
        if settings.get("task") in (task, ALL_TASKS):
            found = _over(found, before)
    return _over(found, settings)


def _over(defaults: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    out = {**defaults, **settings}
    for name, value in settings.items():
        if isinstance(value, Mapping) and isinstance(defaults.get(name), Mapping):
            out[name] = _over(defaults[name], value)
    return out
