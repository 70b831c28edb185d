"""`egovcp-info`: versions, hardware and planner backends."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from egovcp.info import main


def test_it_reports_versions_hardware_and_backends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "info.json"
    assert main([f"--json={file}"]) == 0
    report = json.loads(file.read_text("utf-8"))
    assert report["planner_backends"].keys() == {"eager", "float32", "int8"}
    assert report["versions"]["torch"]
    printed = capsys.readouterr().out
    assert "planner backend int8" in printed
    assert "hardware_cpu" in printed
