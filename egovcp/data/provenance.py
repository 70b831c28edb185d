"""How a dataset came to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Provenance:
    """How a dataset came to be; stored in ``meta/collection.json``."""

    controller_id: str
    """Low-level controller that turned the actions into joint targets."""
    seed: int | None = None
    """Seed of the collection."""
    command: str = ""
    """Command line that repeats it."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Installed version of each package that shapes the data."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """Complete configuration of the simulator and of the behaviour policy."""
