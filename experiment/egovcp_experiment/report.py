"""Reports of experiments, written as JSON, Markdown and a self-contained HTML page."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any, Final

from egovcp.files import write_json, write_text
from egovcp_experiment.cell import Record

_SMOKE: Final = "Scale `smoke`: every command ran once. **The metrics mean nothing.**"
#: Explains the tables and plots of experiments that play scenarios.
INTERVALS: Final = (
    "In brackets and bands: 95 % intervals over scenarios, which do not include how trainings "
    "differ by their seeds. The rows of a table play the same scenarios; differences are paired."
)
_ORIGIN: Final = "How each number was made"
_DIGITS: Final = 12  # of a shortened hash
_STYLE: Final = """
body { font: 15px/1.45 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; font-size: 13px; margin: 0.5em 0 1.5em; }
td, th { border-bottom: 1px solid #ddd; padding: 2px 10px 2px 0; text-align: left; }
td { font-variant-numeric: tabular-nums; }
code { font-size: 12px; overflow-wrap: anywhere; }
figure { margin: 1em 0; } figcaption { color: #555; font-size: 13px; }
svg { max-width: 100%; height: auto; }
.lead { background: #f4f4ee; padding: 0.5em 1.5em; }
"""


@dataclass(frozen=True)
class Table:
    """Rows of text below a head."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Plot:
    """A plot in SVG."""

    name: str
    """Part of the file name."""
    caption: str
    svg: str
    """The element, without an XML head."""


type Part = str | Table | Plot


@dataclass
class ExperimentReport:
    """Findings of an experiment."""

    title: str
    """One line."""
    lead: list[str] = field(default_factory=list)
    """The sentences that matter, about three; they begin the page."""
    plot: Plot | None = None
    """The plot that matters, next on the page."""
    note: str = INTERVALS
    """How to read tables and plots, next on the page."""
    findings: list[str] = field(default_factory=list)
    """Further conclusions that are derived from the metrics."""
    sections: list[Part] = field(default_factory=list)
    """Paragraphs, tables and plots."""
    metrics: dict[str, Any] = field(default_factory=dict)
    """The report's numbers as JSON."""


def number(value: float | None, form: str = ".3g") -> str:
    """A number; None as a dash."""
    return "-" if value is None else format(value, form)


def percent(rate: float | None) -> str:
    """0.875 as 87.5 %; None as a dash."""
    return "-" if rate is None else f"{100 * rate:.1f} %"


def percent_range(interval: Sequence[float]) -> str:
    """An interval of rates as ``80.1 to 92.3 %``."""
    return f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f} %"


def listed(parts: Sequence[str]) -> str:
    """``a, b and c``."""
    return " and ".join(part for part in (", ".join(parts[:-1]), parts[-1]) if part)


def on_tasks(words: Mapping[str, str]) -> str:
    """Task -> word, as ``better on ball and wall and worse on arch``."""
    return listed(
        [
            f"{word} on {listed([task for task in words if words[task] == word])}"
            for word in dict.fromkeys(words.values())
        ]
    )


def draw(
    name: str,
    caption: str,
    paint: Callable[[Any], None],
    size: tuple[float, float] = (8.0, 3.2),
) -> Plot:
    """Draw with Matplotlib; equal names and plots give equal files.

    ``paint`` gets an empty `matplotlib.figure.Figure` of this width and height, inches.
    """
    import matplotlib  # takes a second
    from matplotlib.figure import Figure

    with matplotlib.rc_context(
        {"svg.fonttype": "none", "svg.hashsalt": name, "font.size": 9, "axes.grid": False}
    ):
        figure = Figure(figsize=size, layout="constrained")
        paint(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    whole = text.getvalue()
    return Plot(name, caption, whole[whole.index("<svg") :].strip())


def publish(
    folder: Path,
    name: str,
    report: ExperimentReport,
    records: Mapping[str, Record],
    missing: Sequence[str],
    config: Mapping[str, Any],
    command: str,
) -> None:
    """Write NAME.json, NAME.md with its plots, and NAME.html.

    Args:
        records: results of the cells that the report is made from.
        missing: names of incomplete cells.
        command: command line that repeats the experiment.
    """
    notes = [_SMOKE] if config["scale"] == "smoke" else []
    if missing:
        total = len(records) + len(missing)
        notes.append(f"**Incomplete**: {len(records)} of {total} cells so far.")
    report = replace(report, lead=[*notes, *report.lead])
    origin = _origin(records, command)
    content = {
        "experiment": name,
        "title": report.title,
        "lead": report.lead,
        "findings": report.findings,
        "metrics": report.metrics,
        "cells": dict(records),
        "missing": list(missing),
        "config": config,
        "command": command,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_json(folder / f"{name}.json", content)
    for part in (report.plot, *report.sections):
        if isinstance(part, Plot):
            head = '<?xml version="1.0" encoding="utf-8"?>\n'
            write_text(folder / f"{name}-{part.name}.svg", f"{head}{part.svg}\n")
    write_text(folder / f"{name}.md", _markdown(report, origin, name))
    write_text(folder / f"{name}.html", _html(report, origin))


def _origin(records: Mapping[str, Record], command: str) -> list[Part]:
    """Machines, versions, and the command and hashes of each cell."""
    machines = dict.fromkeys(
        f"{r['hardware_cpu']}, {r['hardware_cores']} cores, GPU {r['hardware_gpu']}"
        for r in records.values()
    )
    versions = dict.fromkeys(
        ", ".join(f"{name} {v}" for name, v in r["settings"]["versions"].items())
        for r in records.values()
    )
    rows = [
        (
            name,
            f"{record['minutes']:.1f}",
            record["date"][:10],
            f"`{record['settings_sha256'][:_DIGITS]}`",
            f"`{record['sha256'][:_DIGITS]}`",
            f"`{record['command']}`",
        )
        for name, record in records.items()
    ]
    head = ("cell", "minutes", "date", "settings", "result", "command")
    commits = dict.fromkeys(r["commit"] for r in records.values() if r.get("commit"))
    code = [*versions, *(f"commit {commit}" for commit in commits)]
    return [
        f"Made by `{command}` on {'; '.join(machines) or 'nothing yet'} ({'; '.join(code)}).",
        Table("Cells, with the SHA-256 of settings and results", head, rows),
    ]


def _markdown(report: ExperimentReport, origin: Sequence[Part], stem: str) -> str:
    def convert(part: Part) -> str:
        if isinstance(part, Plot):
            alt = f"{stem} {part.name}".replace("-", " ")
            return f"![{alt}]({stem}-{part.name}.svg)\n\n*{part.caption}*"
        if isinstance(part, str):
            return part
        lines = [part.head, ("---",) * len(part.head), *part.rows]
        cells = ([cell.replace("|", "\\|") for cell in line] for line in lines)
        rows = "\n".join(f"| {' | '.join(line)} |" for line in cells)
        return f"**{part.title}**\n\n{rows}" if part.title else rows

    lead = " ".join(report.lead)
    plot = [convert(report.plot)] if report.plot else []
    findings = "\n".join(f"- {line}" for line in report.findings)
    made = f"## {_ORIGIN}"
    sections = [convert(part) for part in (*report.sections, made, *origin)]
    blocks = [f"# {report.title}", lead, *plot, report.note, findings, *sections]
    return "\n\n".join(block for block in blocks if block) + "\n"


def _html(report: ExperimentReport, origin: Sequence[Part]) -> str:
    def convert(part: Part) -> str:
        if isinstance(part, Plot):
            caption = escape(part.caption)
            return f"<figure>{part.svg}<figcaption>{caption}</figcaption></figure>"
        if isinstance(part, str):
            return f"<p>{_inline(part)}</p>"
        head = "".join(f"<th>{_inline(cell)}</th>" for cell in part.head)
        rows = "\n".join(
            f"<tr>{''.join(f'<td>{_inline(cell)}</td>' for cell in row)}</tr>" for row in part.rows
        )
        title = f"<h3>{escape(part.title)}</h3>\n" if part.title else ""
        return f"{title}<table><tr>{head}</tr>\n{rows}</table>"

    title = escape(report.title)
    lead = "".join(f"<p>{_inline(line)}</p>" for line in report.lead)
    plot = convert(report.plot) if report.plot else ""
    note = f"<p>{_inline(report.note)}</p>" if report.note else ""
    findings = "".join(f"<li>{_inline(line)}</li>" for line in report.findings)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{title}</title><style>{_STYLE}</style></head><body>\n<h1>{title}</h1>\n"
        f'<div class="lead">{lead}</div>\n{plot}\n{note}\n<ul>{findings}</ul>\n'
        + "\n".join(map(convert, report.sections))
        + f"\n<details><summary>{_ORIGIN}</summary>\n"
        + "\n".join(map(convert, origin))
        + "\n</details>\n</body></html>\n"
    )


def _inline(text: str) -> str:
    """Escaped text with the `code` and **bold** of Markdown."""
    bold = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", escape(text))
    return re.sub(r"`(.+?)`", r"<code>\1</code>", bold)
