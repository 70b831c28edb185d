"""Writes a report: NAME.json, NAME.md with its drawings, NAME.html."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from egovcp.files import write_json, write_text
from egovcp_experiment.report.document import Report, Table
from egovcp_experiment.report.html import page
from egovcp_experiment.report.markdown import drawings, markdown
from egovcp_experiment.store import Record

_SMOKE: Final = "Scale `smoke`: every command ran once. **The figures mean nothing.**"
_DIGITS: Final = 12


def publish(
    folder: Path,
    name: str,
    report: Report,
    records: Mapping[str, Record],
    missing: Sequence[str],
    config: Mapping[str, Any],
    command: str,
) -> None:
    """Write the files of a report, replacing those of an earlier one.

    Args:
        folder: where to.
        name: of the experiment.
        report: what was found.
        records: results of the cells that it rests on.
        missing: names of the cells that are not complete.
        config: the whole configuration.
        command: what repeats it.
    """
    notes = [_SMOKE] if config["scale"] == "smoke" else []
    if missing:
        total = len(records) + len(missing)
        notes.append(f"**Incomplete**: {len(records)} of {total} cells so far.")
    report = Report(report.title, (*notes, *report.shows), report.parts, report.figures)
    origin = _origin(records, command)
    content = {
        "experiment": name,
        "title": report.title,
        "shows": list(report.shows),
        "figures": report.figures,
        "cells": dict(records),
        "missing": list(missing),
        "config": config,
        "command": command,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_json(folder / f"{name}.json", content)
    for path, text in drawings(report, name).items():
        write_text(folder / path, text)
    write_text(folder / f"{name}.md", markdown(report, origin, name))
    write_text(folder / f"{name}.html", page(report, origin))


def _origin(records: Mapping[str, Record], command: str) -> list[str | Table]:
    """How the figures were made: machine, commands and hashes."""
    machines = dict.fromkeys(
        f"{r['hardware_cpu']}, {r['hardware_cores']} cores, GPU {r['hardware_gpu']}"
        for r in records.values()
    )
    versions = dict.fromkeys(
        ", ".join(f"{name} {v}" for name, v in r["settings"]["versions"].items())
        for r in records.values()
    )
    rows = tuple(
        (
            name,
            f"{record['minutes']:.1f}",
            record["date"],
            f"`{record['settings_sha256'][:_DIGITS]}`",
            f"`{record['sha256'][:_DIGITS]}`",
            f"`{record['command']}`",
        )
        for name, record in records.items()
    )
    head = ("cell", "minutes", "date", "settings", "result", "command")
    return [
        f"Made by `{command}` on {'; '.join(machines) or 'nothing yet'} ({'; '.join(versions)}).",
        Table("Cells, with the SHA-256 of settings and results", head, rows),
    ]
