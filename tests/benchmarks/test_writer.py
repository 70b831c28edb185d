"""All writers of the benchmark accept the episodes."""

import json
from pathlib import Path

import pytest
import writer


def test_all_writers_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "metrics.json"
    flags = f"--json {out} --episodes 2 --ticks 4 --rounds 1"
    monkeypatch.setattr("sys.argv", ["writer.py", *flags.split()])
    writer.main()
    metrics = json.loads(out.read_text())
    assert all(metrics[f"{name}_frames_per_s"] > 0 for name in ("lerobot", "writer", "collect"))
