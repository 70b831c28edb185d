"""Reports have the same content in three forms; the page is self-contained."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from egovcp_experiment.report import ExperimentReport, Table, draw, publish

RECORD: dict[str, Any] = {
    "command": "egovcp-train --steps=3",
    "minutes": 1.25,
    "date": "2026-01-01T00:00:00+00:00",
    "settings": {"versions": {"egovcp": "0.1.0"}},
    "settings_sha256": "a" * 64,
    "sha256": "b" * 64,
    "hardware_cpu": "a processor",
    "hardware_cores": 2,
    "hardware_gpu": "none",
    "commit": "1a2b3c4+",
    "metrics": {},
}


def _report() -> ExperimentReport:
    plot = draw("curve", "a curve & more", lambda figure: figure.subplots().plot([1, 2]))
    table = Table("rows", ("name", "value"), (("a|b", "`x<1`"),))
    return ExperimentReport(
        "Title <1>",
        lead=["Ours is **worse**."],
        plot=replace(plot, name="main", caption="the plot"),
        findings=["a detail"],
        sections=["text", table, plot],
        metrics={"x": 1.5},
    )


def _publish(folder: Path, scale: str = "small", missing: tuple[str, ...] = ()) -> None:
    command = "egovcp-experiment test --output_dir=out"
    publish(folder, "test", _report(), {"cell": RECORD}, missing, {"scale": scale}, command)


def test_three_forms_have_the_same_content(tmp_path: Path) -> None:
    _publish(tmp_path)
    content = json.loads((tmp_path / "test.json").read_text())
    text = (tmp_path / "test.md").read_text()
    page = (tmp_path / "test.html").read_text()
    assert content["metrics"] == {"x": 1.5}
    assert "| a\\|b | `x<1` |" in text
    assert "<td>a|b</td><td><code>x&lt;1</code></td>" in page
    assert "Title &lt;1&gt;" in page
    assert "<b>worse</b>" in page
    for form in (text, page):
        assert "egovcp-train --steps=3" in form
        assert "a processor, 2 cores" in form
        assert "b" * 12 in form
        assert "commit 1a2b3c4+" in form
    assert (tmp_path / "test-curve.svg").read_text().startswith("<?xml")


def test_the_page_refers_to_nothing_outside(tmp_path: Path) -> None:
    _publish(tmp_path)
    page = (tmp_path / "test.html").read_text()
    assert "<svg" in page
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]*"', page)
    assert "@import" not in page


def test_a_report_without_scenarios_does_not_explain_their_intervals(tmp_path: Path) -> None:
    publish(tmp_path, "test", replace(_report(), note=""), {}, (), {"scale": "small"}, "command")
    for form in ("test.md", "test.html"):
        assert "95 %" not in (tmp_path / form).read_text()


def test_plots_are_reproducible() -> None:
    assert _report().sections[2] == _report().sections[2]


def test_smoke_and_missing_cells_come_first(tmp_path: Path) -> None:
    _publish(tmp_path, "smoke", ("other",))
    lead = json.loads((tmp_path / "test.json").read_text())["lead"]
    assert "mean nothing" in lead[0]
    assert "1 of 2 cells" in lead[1]


def test_the_sentences_and_the_plot_that_matter_come_before_the_rest(tmp_path: Path) -> None:
    _publish(tmp_path)
    for form in ("test.md", "test.html"):
        text = (tmp_path / form).read_text()
        parts = ("Ours is", "the plot", "95 % intervals over", "a detail", "name", "egovcp-train")
        places = [text.index(part) for part in parts]
        assert places == sorted(places)
    assert (tmp_path / "test-main.svg").exists()
