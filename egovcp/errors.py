"""Errors that a user can cause, with their exit codes.

A message says what was found, what was expected, where, and what to do.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable
from typing import Self


class EgovcpError(Exception):
    """Base class; ``exit_code`` is the exit code of the command."""

    exit_code = 1


class UsageError(EgovcpError):
    """A flag or an argument is wrong."""

    exit_code = 2


class DataError(EgovcpError):
    """A dataset is missing, damaged, of another schema, or cannot be mixed."""

    exit_code = 3
    problem: str = ""
    """The problem without its place; empty: only the message is known."""
    file: str = ""
    """The damaged file, if known."""
    episode: int | None = None
    """The damaged episode, if it is one."""
    frame: int | None = None
    """The frame in the episode, if it is one."""

    @classmethod
    def at(
        cls,
        file: str | os.PathLike[str],
        problem: str,
        episode: int | None = None,
        frame: int | None = None,
    ) -> Self:
        """An error with the message ``"FILE, episode 3, frame 7: problem"``."""
        numbers = {"episode": episode, "frame": frame}
        place = [f"{name} {number}" for name, number in numbers.items() if number is not None]
        path = os.fsencode(file).decode("utf-8", "backslashreplace")  # a name is bytes
        error = cls(f"{', '.join([path, *place])}: {problem}")
        error.problem, error.file, error.episode, error.frame = problem, str(file), episode, frame
        return error

    @classmethod
    def without_place(cls, problem: str, frame: int | None = None) -> Self:
        """An error, of one frame or not, whose file and episode the caller adds."""
        error = cls(problem if frame is None else f"frame {frame}: {problem}")
        error.problem, error.frame = problem, frame
        return error


class SchemaError(DataError):
    """A column is missing or differs from its feature in ``meta/info.json``."""


class SimulationDiverged(DataError):
    """The physics of an episode diverged; the episode is not valid data."""


class ArtifactError(EgovcpError):
    """A policy artifact is missing, tampered with, or of another spec."""

    exit_code = 4


class EnvironmentFailure(EgovcpError):
    """The machine or other software prevents the work: disk, permissions, network, device, port, a
    missing package, a defective plugin, a failed process, or a file that exists already."""

    exit_code = 5


class SafetyStop(EgovcpError):
    """The robot was stopped for safety."""

    exit_code = 6


class ConformanceError(EgovcpError):
    """A component violates its interface (see `egovcp.checks`)."""


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """``"; did you mean 'ball'?"`` for an unknown ``name``; empty: no similar name."""
    near = difflib.get_close_matches(name, sorted(valid), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def suggest(name: str, valid: Iterable[str]) -> str:
    """``"; did you mean 'ball'? choose from: arch, ball, wall"`` for an unknown ``name``."""
    choices = sorted(valid)
    return f"{did_you_mean(name, choices) or ';'} choose from: {', '.join(choices)}"


def suggest_path(path: str | os.PathLike[str]) -> str:
    """``"; did you mean data/ball?"`` for a path that does not exist; empty: no similar name."""
    known, missing = os.path.split(os.fspath(path).rstrip("/"))
    while known and not os.path.lexists(known):
        known, missing = os.path.split(known)
    try:
        near = difflib.get_close_matches(missing, os.listdir(known or "."), n=1)
    except OSError:
        return ""
    return f"; did you mean {os.path.join(known, near[0])}?" if near else ""
