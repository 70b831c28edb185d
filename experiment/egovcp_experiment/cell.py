"""A cell: one run of a command, and what it takes from the cells before it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from egovcp.errors import UsageError

type Flags = Mapping[str, Any]
"""Name of a flag, without the dashes -> its value: text, number, truth, list or mapping of these,
with an `Output`, a `Found` or a `Given` anywhere in it."""


@dataclass(frozen=True)
class Output:
    """A file or folder that another cell makes."""

    cell: str
    """Name of that cell."""
    path: str = ""
    """Below its folder; empty: the folder itself."""


@dataclass(frozen=True)
class Found:
    """A figure of another cell's result."""

    cell: str
    """Name of that cell."""
    keys: tuple[str, ...]
    """Where in its figures."""


@dataclass(frozen=True)
class Given:
    """A file or folder that was there before, or something on the Hub."""

    path: str
    """As the user wrote it."""


type Reference = Output | Found | Given


@dataclass(frozen=True)
class Tool:
    """A command that cells run: ``MODULE.main(argv)``."""

    module: str
    """Where its `main` is."""
    output: str
    """The flag that names the folder it writes."""
    figures: Callable[[Path], dict[str, Any]]
    """What is kept of a finished run, from its folder."""
    digest: Callable[[Path], str]
    """SHA-256 of what other cells take from the folder."""
    continued: Callable[[Path], Flags | None] = lambda folder: None
    """Flags that go on with what an interrupted run left in its folder; None: start anew."""
    prog: str = ""
    """Name of the command in reports; empty: ``python -m MODULE``."""
    packages: tuple[str, ...] = ()
    """Modules of optional packages that it imports."""
    learns: bool = False
    """Whether it trains networks, which a GPU is for."""
    alone: bool = False
    """Whether it measures time, so that nothing may run beside it."""


@dataclass(frozen=True)
class Cell:
    """One run of a tool."""

    name: str
    """Unique in an output folder; cells of one name and other settings are refused."""
    tool: Tool
    """What is run."""
    flags: Flags = field(default_factory=dict)
    """Its flags."""
    extra: tuple[str, ...] = ()
    """Further flags as they are written, ``--name=value``."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the cells that must be complete before, each once."""
        found = (r.cell for r in references(self.flags) if not isinstance(r, Given))
        return tuple(dict.fromkeys(found))


def references(value: Any) -> Iterator[Reference]:
    """Every reference in a value, at any depth."""
    if isinstance(value, Output | Found | Given):
        yield value
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from references(part)
    elif isinstance(value, list | tuple):
        for part in value:
            yield from references(part)


def filled(value: Any, fill: Callable[[Reference], Any]) -> Any:
    """The value with ``fill(reference)`` in the place of each reference."""
    if isinstance(value, Output | Found | Given):
        return fill(value)
    if isinstance(value, Mapping):
        return {name: filled(part, fill) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [filled(part, fill) for part in value]
    return value


def written(flags: Flags) -> list[str]:
    """``--name=value`` of flags without references."""
    return [f"--{name}={text(value)}" for name, value in flags.items()]


def text(value: Any) -> str:
    """A flag's value as it is written."""
    return value if isinstance(value, str) else json.dumps(value)


def in_order(cells: Sequence[Cell]) -> tuple[Cell, ...]:
    """The cells, each once, where every one must come after those it needs.

    Raises:
        UsageError: two differ under one name, or one needs what does not come before it.
    """
    known: dict[str, Cell] = {}
    for cell in cells:
        if known.setdefault(cell.name, cell) != cell:
            raise UsageError(f"two different cells are called {cell.name}")
        for name in cell.needs:
            if name not in known:
                raise UsageError(f"cell {cell.name} needs {name}, which does not come before it")
    return tuple(known.values())
