"""`egovcp-dataset`: subcommands, positional folders, help and exit codes."""

import json
from pathlib import Path

import pytest

from egovcp.data import Provenance
from egovcp_collect.dataset.cli import COMMANDS, main

from .conftest import write

pytestmark = pytest.mark.usefixtures("no_network")


def test_help_has_a_line_for_every_subcommand(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, entry in COMMANDS.subcommands.items():
        assert any(line.split()[:1] == [name] and entry.summary in line for line in lines)
    assert main([]) == 2


@pytest.mark.parametrize("name", COMMANDS.subcommands)
def test_every_subcommand_lists_its_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith(f"egovcp-dataset {name}: ")
    assert "--dataset.root" in out


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["chek"], "did you mean 'check'"),
        (["check", "a", "b"], "unexpected argument 'b'; usage: egovcp-dataset check DATASET"),
        (["check"], "no dataset is named"),
        (["check", "{sound}", "--max_problem=3"], "did you mean '--max_problems'"),
        (["check", "{sound}", "--max_problems=0"], "expected at least 1"),
        (["info", "{sound}", "--json={sound}"], "found a folder, expected a regular file"),
        (
            ["delete", "{sound}", "--output_dir=new", "--episodes=[0,6]"],
            "names episode 6, but the dataset has",
        ),
        (
            ["delete", "{sound}", "--output_dir=new", "--episodes=1000"],
            "--episodes=1000: for a single episode write",
        ),
    ],
)
def test_invalid_arguments_are_usage_errors_in_one_line(
    args: list[str], message: str, sound: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([arg.format(sound=sound) for arg in args]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "form", [["{root}"], ["--dataset.root={root}"], ["--dataset.root", "{root}"]]
)
def test_the_folder_may_be_given_in_any_form(
    form: list[str], sound: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", *(part.format(root=sound) for part in form)]) == 0
    assert "6, 1 of them held out" in capsys.readouterr().out


def test_the_folder_may_follow_options(sound: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    assert main(["check", "--json", str(report), "--debug", str(sound)]) == 0
    assert json.loads(report.read_text())["ok"]


def test_a_folder_is_preferred_to_an_id_of_the_same_name(
    sound: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sound.parent.parent)
    assert main(["info", f"{sound.parent.name}/{sound.name}"]) == 0
    assert str(sound) in capsys.readouterr().out


@pytest.mark.parametrize(("seed", "shown"), [(None, "none"), (6, "several")])
def test_info_shows_no_or_several_seeds(
    seed: int | None, shown: str, sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write(tmp_path / "one", [6], Provenance("stance-1", seed))
    if seed is not None:
        merged = tmp_path / "merged"
        assert main(["merge", str(sound), str(root), f"--output_dir={merged}"]) == 0
        root = merged
    capsys.readouterr()
    assert main(["info", str(root)]) == 0
    (line,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("seed")]
    assert line.split()[1:] == [shown]


def test_info_reports_counts_and_provenance(sound: Path, tmp_path: Path) -> None:
    report = tmp_path / "info.json"
    assert main(["info", str(sound), f"--json={report}"]) == 0
    facts = json.loads(report.read_text())
    assert facts["tasks"] == {
        "ball": {"episodes": 3, "frames": 33},
        "wall": {"episodes": 3, "frames": 24},
    }
    assert (facts["episodes"], facts["frames"]) == (6, 57)
    assert (facts["controller_id"], facts["seed"]) == ("stance-1", 5)
    assert facts["features"]["action"] == {"dtype": "float32", "shape": [7]}
    assert facts["bytes"] == sum(p.stat().st_size for p in sound.rglob("*") if p.is_file())
