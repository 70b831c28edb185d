"""`egovcp-dataset check`: problems with their places, duplicates, hidden files."""

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from egovcp import spec
from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    Episode,
    EpisodeStore,
    Provenance,
)
from egovcp.data.committer import load_append_state, open_committer
from egovcp_collect.dataset.cli import main

from . import damage as d
from .conftest import COLLECTED, walk, write

pytestmark = pytest.mark.usefixtures("no_network")


def test_a_sound_dataset_passes(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    assert main(["check", str(sound), f"--json={report}"]) == 0
    assert "6 episodes, 57 frames, nothing wrong" in capsys.readouterr().out
    assert json.loads(report.read_text()) == {
        "ok": True,
        "episodes": 6,
        "frames": 57,
        "problems": [],
        "not_checked": [],
    }


def test_every_problem_is_listed_up_to_the_limit(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / d.HASHES).unlink()
    d.column("next.reward", d.put(14, float("nan")))(copy)
    d.column("timestamp", d.put(15, 9.0))(copy)
    d.column("next.reward", d.put(1, float("inf")), d.MORE_DATA)(copy)
    d.info(total_tasks=5)(copy)
    report = tmp_path / "report.json"
    assert main(["check", str(copy), f"--json={report}"]) == 3
    problems = json.loads(report.read_text())["problems"]
    assert [(p["file"], p["episode"], p["frame"]) for p in problems] == [
        (d.INFO, None, None),
        (d.DATA, 1, 3),
        (d.DATA, 1, 2),
        (d.MORE_DATA, 3, 1),
    ]
    assert main(["check", str(copy), f"--json={report}", "--max_problems=2"]) == 3
    assert json.loads(report.read_text())["problems"] == problems[:2]
    shown = capsys.readouterr()
    assert "stopped after 2 problems" in shown.out
    assert "more than 2 problem(s)" in shown.err
    assert main(["check", str(copy), f"--json={report}", "--max_problems=4"]) == 3
    assert json.loads(report.read_text())["not_checked"] == []
    shown = capsys.readouterr()
    assert "stopped" not in shown.out
    assert "error: 4 problem(s)" in shown.err


def test_a_wrong_statistic_is_reported_with_the_name_of_its_value(
    copy: Path, tmp_path: Path
) -> None:
    (copy / d.HASHES).unlink()
    d.edit(d.STATS, lambda content: d.put(1, 9.0)(content["action"]["mean"]))(copy)
    report = tmp_path / "report.json"
    assert main(["check", str(copy), f"--json={report}"]) == 3
    (problem,) = json.loads(report.read_text())["problems"]
    assert f"action: mean of action[1] ({spec.ACTION_NAMES[1]}) is 9, its" in problem["problem"]


def test_every_damaged_meta_file_is_listed(copy: Path, tmp_path: Path) -> None:
    (copy / d.HASHES).unlink()
    for name in (d.INFO, d.TASKS, d.STATS):
        d.cut(name, 0.5)(copy)
    report = tmp_path / "report.json"
    assert main(["check", str(copy), f"--json={report}"]) == 3
    problems = json.loads(report.read_text())["problems"]
    assert {p["file"] for p in problems} == {d.INFO, d.TASKS, d.STATS}


def test_a_snapshot_of_the_hubs_cache_may_link_to_its_blobs(copy: Path, tmp_path: Path) -> None:
    blobs, snapshot = tmp_path / "repo/blobs", tmp_path / "repo/snapshots/abc"
    blobs.mkdir(parents=True)
    for number, path in enumerate(sorted(p for p in copy.rglob("*") if p.is_file())):
        link = snapshot / path.relative_to(copy)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(path.rename(blobs / str(number)))
    assert main(["check", str(snapshot)]) == 0


def test_a_missing_folder_is_reported_without_network_access(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(tmp_path / "none")]) == 3
    assert "no such folder" in capsys.readouterr().err


def test_the_suggested_command_quotes_the_folder(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(sound, tmp_path / "two words"))
    d.info(total_tasks=5)(root)
    assert main(["check", str(root)]) == 3
    (command,) = re.findall(r"`(egovcp-dataset repair .*?)`", capsys.readouterr().err)
    assert shlex.split(command)[2] == str(root)


@pytest.mark.parametrize("command", ["check", "repair", "info"])
def test_a_revision_of_a_folder_is_refused(
    command: str, sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [f"--output_dir={tmp_path / 'new'}"] if command == "repair" else []
    assert main([command, str(sound), "--dataset.revision=v1", *flags]) == 2
    assert "--dataset.revision selects a version on the Hub" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("second", "file", "words"),
    [
        (walk(0, 12), d.DATA, "repeats episode 0"),
        (
            replace(walk(7, 12), metadata={"seed": 5, "episode": 0}),
            d.COLLECTION,
            r"is ball/5/0 (task/seed/number), as episode 0, but its content differs",
        ),
        (replace(walk(0, 12), metadata={"seed": 5, "episode": 3}), d.DATA, "repeats episode 0"),
    ],
)
@pytest.mark.parametrize("hashed", [True, False])
def test_a_duplicate_episode_is_found(
    second: Episode, file: str, words: str, hashed: bool, tmp_path: Path
) -> None:
    root, report = tmp_path / "twice", tmp_path / "report.json"
    with DatasetWriter(root, COLLECTED) as writer:
        for episode in (walk(0, 12), walk(1, 7), second):
            writer.add(episode)
    if not hashed:
        (root / d.HASHES).unlink()
        d.edit(d.COLLECTION, lambda c: [r.pop("sha256") for r in c["episodes"]])(root)
    assert main(["check", str(root), f"--json={report}"]) == 3
    problems = json.loads(report.read_text())["problems"]
    assert [(p["file"], p["episode"], p["problem"]) for p in problems] == [(file, 2, words)]
    new = tmp_path / "new"
    assert main(["repair", str(root), f"--output_dir={new}"]) == 0
    assert main(["check", str(new)]) == 0


def test_recorded_rollouts_of_one_scenario_are_different_episodes(tmp_path: Path) -> None:
    root = tmp_path / "rollouts"
    with DatasetWriter(root, COLLECTED) as writer:
        for number in range(2):
            facts = {"rollout": {"seed": 5, "episode": 0}}
            writer.add(replace(walk(number, 12), metadata=facts))
    assert main(["check", str(root)]) == 0


@pytest.mark.parametrize("source", [2, -1, True, "x", None])
def test_an_episode_of_an_unknown_source_is_found(
    source: object, sound: Path, tmp_path: Path
) -> None:
    other = write(tmp_path / "other", [6], Provenance("stance-1", 6, config={"eta": 0.1}))
    merged, report = tmp_path / "merged", tmp_path / "report.json"
    assert main(["merge", str(sound), str(other), f"--output_dir={merged}"]) == 0
    (merged / d.HASHES).unlink()
    change = d.edit(d.COLLECTION, lambda c: c["episodes"][6]["metadata"].update({"source": source}))
    change(merged)
    assert main(["check", str(merged), f"--json={report}"]) == 3
    (problem,) = json.loads(report.read_text())["problems"]
    assert (problem["file"], problem["episode"]) == (d.COLLECTION, 6)
    new = tmp_path / "new"
    assert main(["repair", str(merged), f"--output_dir={new}"]) == 0
    assert main(["check", str(new), f"--json={report}"]) == 0
    assert json.loads(report.read_text())["episodes"] == 6


_APPLE_DOUBLE = b"\0\5\x16\7\0\2\0\0Mac OS X        " + bytes(100)


@pytest.fixture
def from_mac(sound: Path, tmp_path: Path) -> Path:
    """A copy of the sound dataset with the files that macOS adds on foreign disks."""
    root = Path(shutil.copytree(sound, tmp_path / "copy"))
    for path in [p for p in root.rglob("*") if p.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(_APPLE_DOUBLE)
    for folder in (root, root / "data", root / "meta", root / "meta/episodes/chunk-000"):
        (folder / ".DS_Store").write_bytes(bytes(6148))
    (root / "data" / ".ipynb_checkpoints").mkdir()
    (root / "data" / ".ipynb_checkpoints" / "file-000.parquet").write_bytes(b"x")
    return root


@pytest.mark.parametrize("hashed", [True, False])
def test_check_names_files_of_macos_that_it_ignored(
    from_mac: Path, hashed: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    if not hashed:
        (from_mac / "meta/sha256.json").unlink()
    assert main(["check", str(from_mac)]) == 0
    note = capsys.readouterr().out
    assert "hidden files and folders such as ._NAME of macOS" in note
    (command,) = re.findall(r"remove them: (find .*)", note)
    subprocess.run(command, shell=True, check=True)
    assert main(["check", str(from_mac)]) == 0
    assert "hidden" not in capsys.readouterr().out


def test_a_dataset_without_hidden_files_has_no_note(
    sound: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(sound)]) == 0
    assert "hidden" not in capsys.readouterr().out


def _load(root: Path, new: Path) -> int:
    return len(EpisodeStore.load([DatasetReader.open(DatasetConfig(root=str(root)))]).length)


def _info(root: Path, new: Path) -> int:
    assert main(["info", str(root), f"--json={new}"]) == 0
    return int(json.loads(new.read_text())["episodes"])


def _repair(root: Path, new: Path) -> int:
    report = new.with_suffix(".json")
    assert main(["repair", str(root), f"--output_dir={new}", f"--json={report}"]) == 0
    assert json.loads(report.read_text())["dropped"] == []
    return len(DatasetReader.open(DatasetConfig(root=str(new))))


def _merge(root: Path, new: Path) -> int:
    other = write(new.with_name("other"), [6])
    assert main(["merge", str(root), str(other), f"--output_dir={new}"]) == 0
    return len(DatasetReader.open(DatasetConfig(root=str(new)))) - 1


def _resume(root: Path, new: Path) -> int:
    assert load_append_state(root).next_number == 6
    with open_committer(root, COLLECTED, 3, lambda provenance: None) as committer:
        return committer.committed


@pytest.mark.parametrize("read", [_load, _info, _repair, _merge, _resume])
def test_every_reader_ignores_hidden_files(
    read: Callable[[Path, Path], int], from_mac: Path, tmp_path: Path
) -> None:
    assert read(from_mac, tmp_path / "new") == 6
