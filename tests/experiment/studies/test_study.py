"""Options that all studies share."""

from __future__ import annotations

from pathlib import Path

import pytest

from egovcp_experiment.studies.behaviour import main
from egovcp_experiment.studies.study import StudyConfig


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "--output_dir is missing"),
        (["--output_dir=full"], "--output_dir=full holds a result already"),
        (["--output_dir=new", "--seed=-1"], "--seed=-1"),
    ],
)
def test_wrong_options_are_refused_before_the_policy_is_loaded(
    flags: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "result.json").touch()
    assert main(["--policy.path=missing", *flags]) == 2
    assert message in capsys.readouterr().err


def test_the_home_folder_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    config = StudyConfig(output_dir="~/out")
    config.check()
    config.write({"points": 1})
    assert (tmp_path / "out" / "result.json").is_file()
