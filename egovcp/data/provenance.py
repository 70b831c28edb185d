"""How a dataset came to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from egovcp.errors import DataError


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


def parse_provenance(content: object, path: str | Path, where: str = "") -> Provenance:
    """The provenance in a JSON object; entries that it does not define are ignored.

    Args:
        content: as `json.loads` returns it.
        path: the file that it is in.
        where: the place in the file, for messages, such as ``"config.sources[0]: "``.

    Raises:
        DataError: an entry is missing or of another type.
    """
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise DataError.at(path, f"{where}holds a {kind}, expected an object")
    if not isinstance(content.get("controller_id"), str) or not content["controller_id"]:
        raise DataError.at(path, f"{where}names no low-level controller")
    seed = content.get("seed")
    if isinstance(seed, bool) or not isinstance(seed, int | None):
        kind = type(seed).__name__
        raise DataError.at(path, f"{where}its seed is a {kind}, expected an integer")
    if not isinstance(content.get("command", ""), str):
        raise DataError.at(path, f"{where}its command is no string")
    for key in ("config", "versions"):
        if not isinstance(content.get(key, {}), dict):
            raise DataError.at(path, f"{where}its {key} is no object")
    if not all(isinstance(version, str) for version in content.get("versions", {}).values()):
        raise DataError.at(path, f"{where}its versions are no strings")
    names = [field.name for field in fields(Provenance)]
    return Provenance(**{key: content[key] for key in names if key in content})
