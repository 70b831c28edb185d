"""Options that the commands of this package share, and their checks before any work starts."""

from __future__ import annotations

import os
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, Final

import draccus

from egovcp.errors import UsageError
from egovcp.files import user_path
from egovcp.hub import is_local_path
from egovcp.outputs import require_writable
from egovcp.packages import is_installed, versions_of
from egovcp.sim.scenario import HELD_OUT, SEARCH, Scenario

PLANNER: Final = "planner"
SEEDS: Final = SEARCH - HELD_OUT
"""Number of seeds of held-out scenarios."""
_PACKAGES: Final = ("egovcp", "egovcp-deploy", "torch", "numpy")


def held_out(task: str, seed: int, episode: int) -> Scenario:
    """Scenario ``episode`` of evaluation and deployment for the user's ``seed``, from 0 to
    `SEEDS` - 1."""
    return Scenario(task, HELD_OUT + seed, episode)


def check_output_dir(path: str) -> Path:
    """The folder of ``--output_dir``, which must be new or empty; it is not created. Raises
    `UsageError` if none is named or it holds files, `EnvironmentFailure` if it is not writable."""
    if not path:
        raise UsageError("--output_dir is missing; name a new folder for the results")
    folder = user_path(path)
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--output_dir={path} is a file; name a new folder")
    present = sorted(entry.name for entry in folder.iterdir()) if folder.exists() else []
    if present:
        raise UsageError(
            f"--output_dir={path} holds {present[0]} already; results are never overwritten: "
            "name another folder or remove this one"
        )
    require_writable(folder)
    return folder


def make_output_dir(path: str) -> Path:
    """Create the folder of ``--output_dir``; raises as `check_output_dir`."""
    folder = check_output_dir(path)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def video_paths(stem: Path) -> list[Path]:
    """``stem`` as GIF, and as MP4 if PyAV is installed."""
    suffixes = [".gif", *([".mp4"] if is_installed("av") else [])]
    return [stem.with_suffix(suffix) for suffix in suffixes]


def encoded(config: object, *paths: str) -> dict[str, Any]:
    """The options as JSON values; local paths in the options ``paths`` become absolute, so that
    they are valid in any working directory."""
    from egovcp.artifact import shipped_policies  # imports torch

    options: dict[str, Any] = draccus.encode(config)
    for option in paths:
        *sections, name = option.split(".")
        section = reduce(getitem, sections, options)
        path = section[name]
        if path and is_local_path(path) and path not in shipped_policies():
            section[name] = os.path.abspath(os.path.expanduser(path))
    return options


def evaluation_versions() -> dict[str, str]:
    """Distribution -> version, of the packages that determine the results."""
    return versions_of(_PACKAGES)
