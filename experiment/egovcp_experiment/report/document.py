"""What a report says, whatever it is written as."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Table:
    """Rows of text under a head."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Plot:
    """A drawing."""

    name: str
    """Part of the name of its file."""
    caption: str
    svg: str
    """The element itself, without an XML head."""


@dataclass(frozen=True)
class Report:
    """What an experiment found."""

    title: str
    """One line."""
    shows: tuple[str, ...]
    """What the figures say, worst news included; made from them."""
    parts: tuple[str | Table | Plot, ...] = ()
    """Paragraphs, tables and drawings."""
    figures: dict[str, Any] = field(default_factory=dict)
    """The same for programs."""


def number(value: float | None, form: str = ".3g") -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else format(value, form)


def percent(rate: float | None) -> str:
    """0.875 as 87.5 %."""
    return "-" if rate is None else f"{100 * rate:.1f} %"


def percent_range(interval: Sequence[float] | None) -> str:
    """An interval of rates as ``80.1 to 92.3 %``."""
    if interval is None:
        return "-"
    return f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f} %"


def points_range(interval: Sequence[float]) -> str:
    """An interval of differences of rates as ``-3.0 to +8.5``, percentage points."""
    return f"{100 * interval[0]:+.1f} to {100 * interval[1]:+.1f}"
