"""What a schedule asks of those who run cells, wherever they do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from egovcp_experiment.cell import Tool

INTERRUPTED: Final = 130  # exit code of a command that Ctrl-C has ended


@dataclass(frozen=True)
class Ended:
    """A command that has come to its end."""

    code: int
    """Its exit code."""
    machine: Mapping[str, Any]
    """Where it ran: what times depend on."""


class Run(Protocol):
    """The command of a cell, running or waiting for room."""

    def ended(self) -> Ended | None:
        """How it ended, if it has; does not wait.

        Raises:
            EnvironmentFailure: it was lost, or could not be begun.
        """
        ...

    def interrupt(self) -> None:
        """Ask it to stop, as Ctrl-C does; it ends a little later."""
        ...

    def kill(self) -> None:
        """End it now, whatever it does; returns when it is gone or out of reach."""
        ...


class Runner(Protocol):
    """Starts commands."""

    def start(self, tool: Tool, argv: Sequence[str], log: Path) -> Run:
        """Run ``tool`` with these arguments; what it prints is added to ``log``."""
        ...

    def close(self) -> None:
        """Free what the runner itself holds; all runs have ended."""
        ...
