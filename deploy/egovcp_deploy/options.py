"""Options that the commands of this package share, and what is checked before any work."""

from __future__ import annotations

import os
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Final

from egovcp.errors import EnvironmentFailure, UsageError, suggest
from egovcp.hub import is_local_path
from egovcp.outputs import require_writable

PLANNER: Final = "planner"
REFERENCES: Final = ("hold", "random", "oracle")
_PACKAGES: Final = ("egovcp", "egovcp-deploy", "torch", "numpy")


def check_choice(flag: str, value: str, valid: Iterable[str]) -> None:
    """Raise `UsageError` unless ``value`` is one of ``valid``."""
    choices = tuple(valid)
    if value not in choices:
        raise UsageError(f"unknown value {flag}={value}{suggest(value, choices)}")


def check_output_dir(path: str, reusable: tuple[str, ...] = ()) -> Path:
    """The output folder; one that holds anything is refused. Creates nothing.

    Args:
        path: the folder of ``--output_dir``.
        reusable: file names that may be there already.

    Raises:
        UsageError: no folder was named, or it holds other files.
        EnvironmentFailure: it cannot be created or written to.
    """
    if not path:
        raise UsageError("--output_dir is missing; name a new folder for the results")
    folder = Path(os.path.expanduser(path))
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--output_dir={path} is a file; name a new folder")
    present = [entry.name for entry in folder.iterdir()] if folder.exists() else []
    foreign = sorted(name for name in present if name not in reusable)
    if foreign:
        raise UsageError(
            f"--output_dir={path} holds {foreign[0]} already; results are never overwritten: "
            "name another folder or remove this one"
        )
    try:
        require_writable(folder)
    except EnvironmentFailure as error:
        raise EnvironmentFailure(f"cannot create {path}: {error}") from error
    return folder


def make_output_dir(path: str, reusable: tuple[str, ...] = ()) -> Path:
    """Create the folder that `check_output_dir` accepts.

    Raises:
        UsageError: as `check_output_dir`.
        EnvironmentFailure: it cannot be created or written to.
    """
    folder = check_output_dir(path, reusable)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnvironmentFailure(f"cannot create {path}: {error.strerror}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise EnvironmentFailure(f"cannot write to {path}: permission denied")
    return folder


def absolute_path(path: str) -> str:
    """A file or folder as it is recorded: found again from any working directory.

    An empty path stays empty, an id on the Hub is none.
    """
    return os.path.abspath(os.path.expanduser(path)) if path and is_local_path(path) else path


def versions() -> dict[str, str]:
    """Distribution -> version of what shaped the results."""
    return {name: version(name) for name in _PACKAGES}
