"""A report as Markdown; drawings are files beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egovcp_experiment.report.document import Plot, Report, Table


def markdown(report: Report, origin: Sequence[str | Table], stem: str) -> str:
    """The text of ``STEM.md``.

    Args:
        report: what was found.
        origin: how it was made, below the rest.
        stem: drawings are called ``STEM-NAME.svg``.
    """
    shows = "\n".join(f"- {line}" for line in report.shows)
    parts = [_part(part, stem) for part in (*report.parts, *origin)]
    return "\n\n".join([f"# {report.title}", "**What it shows**", shows, *parts]) + "\n"


def drawings(report: Report, stem: str) -> dict[Path, str]:
    """File name -> content of the drawings that the Markdown shows."""
    head = '<?xml version="1.0" encoding="utf-8"?>\n'
    return {
        Path(f"{stem}-{part.name}.svg"): f"{head}{part.svg}\n"
        for part in report.parts
        if isinstance(part, Plot)
    }


def table(part: Table) -> str:
    """A table with its title above."""
    lines = [part.head, ("---",) * len(part.head), *part.rows]
    rows = "\n".join(f"| {' | '.join(_cell(cell) for cell in line)} |" for line in lines)
    return f"**{part.title}**\n\n{rows}" if part.title else rows


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _part(part: str | Table | Plot, stem: str) -> str:
    if isinstance(part, Table):
        return table(part)
    if isinstance(part, Plot):
        return f"![{part.caption}]({stem}-{part.name}.svg)\n\n*{part.caption}*"
    return part
