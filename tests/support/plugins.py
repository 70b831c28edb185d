"""Task plugins in the tests: a distribution with metadata in a folder on the module path."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import egovcp.sim.tasks.registry as registry


def install(
    folder: Path, name: str, source: str, entry: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Install the module ``<name>_task`` of distribution ``egovcp-task-<name>``, version 1.2.

    Args:
        folder: a folder for it.
        name: names module and distribution.
        source: content of the module.
        entry: the line of its entry point.
        monkeypatch: undoes it, and makes the registry search again.
    """
    info = folder / f"egovcp_task_{name}-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: egovcp-task-{name}\nVersion: 1.2\n"
    )
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{entry}\n")
    (folder / f"{name}_task.py").write_text(source)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv(registry.VARIABLE, "")
    monkeypatch.delitem(sys.modules, f"{name}_task", raising=False)
    monkeypatch.setattr(registry, "_found", None)
