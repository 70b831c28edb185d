"""`egovcp-dataset audit`: recorded episodes are reproduced, or reported."""

import json
import shutil
from pathlib import Path

import pytest

from egovcp_collect import collect
from egovcp_collect.dataset.cli import main

from . import damage as d


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("audit") / "ball"
    flags = ["--env.ball_episode.ticks=5", "--env.ball_episode.event_ticks=[0,1]", "--episodes=4"]
    assert collect.main([f"--dataset.root={root}", *flags, "--num_workers=1", "--seed=3"]) == 0
    return root


@pytest.fixture
def copy(collected: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(collected, tmp_path / "copy"))


def test_collected_episodes_are_reproduced(collected: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    assert main(["audit", str(collected), "--count=2", f"--json={report}"]) == 0
    assert json.loads(report.read_text()) == {
        "ok": True,
        "episodes": [0, 3],
        "different": [],
        "versions": {},
    }


def test_a_different_episode_is_reported_with_the_versions(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    d.edit(d.COLLECTION, lambda c: c["episodes"][2]["metadata"].update(seed=4))(copy)
    d.edit(d.COLLECTION, lambda c: c["versions"].update(mujoco="3.0.0"))(copy)
    report = tmp_path / "report.json"
    assert main(["audit", str(copy), "--episodes=[1,2]", f"--json={report}"]) == 3
    assert json.loads(report.read_text())["different"] == [2]
    message = capsys.readouterr().err
    assert "episode(s) 2 came out differently" in message
    assert "mujoco was 3.0.0, is 3" in message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["config"].pop("env"), "no configuration of the simulator"),
        (lambda c: c["config"].update(eta="much"), "not one of this version"),
        (lambda c: c["config"]["env"].update(magic=1), "not one of this version"),
        (lambda c: c["episodes"][0]["metadata"].pop("seed"), "its seed is None"),
        (lambda c: c.update(controller_id="other"), "controller other, but here it is"),
    ],
)
def test_missing_information_is_reported(
    change: d.Callable[[dict], object], message: str, copy: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    d.edit(d.COLLECTION, change)(copy)
    assert main(["audit", str(copy), "--episodes=[0]"]) == 3
    assert message in capsys.readouterr().err
