"""`egovcp-dataset coverage`: report, JSON and pictures."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egovcp import packages
from egovcp_collect.dataset.cli import main

from .scenes import scene, three_balls, write_scenes


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three balls and an arch."""
    folder = tmp_path_factory.mktemp("data") / "four"
    arch = scene(3, task="arch", terms=("pass",), length=60, time_limit=60)
    return write_scenes(folder, [*three_balls(), arch]).root


def test_the_verdict_is_always_printed_and_never_fails(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["coverage", str(root)]) == 0
    out = capsys.readouterr().out
    assert out.strip().splitlines()[-1].strip().startswith("train on it with care")
    for word in ("block", "touch.hands", "scene.radius", "left_hand.x", "doubt  ball: too few"):
        assert word in out


def test_json_holds_the_same_and_is_replaced(root: Path, tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text("old")
    assert main(["coverage", str(root), f"--json={path}"]) == 0
    found = json.loads(path.read_text())
    assert set(found["tasks"]) == {"ball", "arch"}
    assert found["tasks"]["ball"]["events"]["block"]["ticks"] == 1
    assert found["verdict"]["worth_training"] is False
    assert {f["task"] for f in found["verdict"]["findings"]} == {"ball", "arch"}
    assert [p.name for p in tmp_path.iterdir()] == ["c.json"]


def test_four_pictures_are_drawn(root: Path, tmp_path: Path) -> None:
    assert main(["coverage", str(root), f"--output_dir={tmp_path / 'new'}"]) == 0
    drawn = sorted(p.name for p in (tmp_path / "new").iterdir())
    assert drawn == ["actions.png", "depth.png", "events.png", "returns.png"]
    for path in (tmp_path / "new").iterdir():
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("L"))
        assert (pixels < 128).sum() > 500, path  # something dark on white
        assert pixels.shape[1] > 700


def test_pictures_of_a_dataset_without_returns_or_events(sound: Path, tmp_path: Path) -> None:
    assert main(["coverage", str(sound), f"--output_dir={tmp_path}"]) == 0
    assert len([*tmp_path.glob("*.png")]) == 4


def test_a_missing_matplotlib_is_said_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "matplotlib")
    nowhere = tmp_path / "nowhere"
    assert main(["coverage", str(nowhere), f"--output_dir={tmp_path / 'pictures'}"]) == 5
    assert "egovcp-collect[pictures]" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_no_dataset_is_a_data_error(tmp_path: Path) -> None:
    assert main(["coverage", f"--dataset.root={tmp_path / 'none'}"]) == 3


def test_returns_over_no_ticks_are_refused(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["coverage", f"--dataset.root={root}", "--returns.steps=0"]) == 2
    assert "--returns.steps=0" in capsys.readouterr().err
