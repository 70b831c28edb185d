"""A command that takes milliseconds, in processes of its own like any other."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from egovcp.files import sha256
from egovcp_experiment.cell import Cell, CellCommand, read_json

_COMMAND = """
import json, sys, time
from pathlib import Path


def main(argv):
    given = dict(arg.removeprefix("--").split("=", 1) for arg in argv)
    folder = Path(given["output_dir"])
    with open(given["diary"], "a") as diary:
        diary.write(f"{folder.name} {given.get('resume', '')}\\n")
    if given.get("fail"):
        print("the cause of it all")
        return int(given["fail"])
    folder.mkdir(parents=True, exist_ok=True)
    if given.get("wait"):
        (folder / "begun").touch()
        try:
            time.sleep(float(given["wait"]))
        except KeyboardInterrupt:
            (folder / "checkpoint").touch()
            return 130
    total = float(given.get("add", 0))
    if "source" in given:
        total += json.loads(Path(given["source"]).read_text())["total"]
    (folder / "result.json").write_text(json.dumps({"total": total}))
    return 0
"""

type MakeCell = Callable[..., Cell]


@pytest.fixture
def diary(tmp_path: Path) -> Path:
    """Every run of the command adds a line: its cell, and how it was resumed."""
    return tmp_path / "diary.txt"


@pytest.fixture
def cell(tmp_path: Path, diary: Path, monkeypatch: pytest.MonkeyPatch) -> MakeCell:
    """Makes cells that add numbers; keyword arguments are flags."""
    (tmp_path / "quick_command.py").write_text(_COMMAND)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    tool = CellCommand(
        module="quick_command",
        prog="quick",
        output="output_dir",
        metrics=lambda folder: dict(read_json(folder / "result.json")),
        digest=lambda folder: sha256(folder / "result.json"),
        minutes=lambda flags: 60.0 * float(flags.get("hours", 0.0)),
        resume_flags=lambda folder: {"resume": True} if (folder / "checkpoint").exists() else None,
    )

    def make(name: str, **flags: object) -> Cell:
        return Cell(name, tool, flags, (f"--diary={diary}",))

    return make
