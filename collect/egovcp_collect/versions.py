"""Versions of what shapes the data, as they are installed."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import Final

_PACKAGES: Final = ("egovcp", "mujoco", "mjlab", "numpy", "lerobot")


def installed_versions() -> dict[str, str]:
    """Package -> version; Python's own under "python"."""
    packages = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return {"python": platform.python_version(), **packages}
