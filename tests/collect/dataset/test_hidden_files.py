"""Files that macOS writes beside those of a dataset are ignored by every reader."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from egovcp.data import DatasetConfig, DatasetReader, EpisodeStore
from egovcp.data.committer import load_append_state, open_committer
from egovcp_collect.dataset.cli import main

from .conftest import COLLECTED, write

_APPLE_DOUBLE = b"\0\5\x16\7\0\2\0\0Mac OS X        " + bytes(100)


@pytest.fixture
def from_mac(sound: Path, tmp_path: Path) -> Path:
    """A copy of the sound dataset from a foreign disk of a Mac."""
    root = Path(shutil.copytree(sound, tmp_path / "copy"))
    for path in [p for p in root.rglob("*") if p.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(_APPLE_DOUBLE)
    for folder in (root, root / "data", root / "meta", root / "meta/episodes/chunk-000"):
        (folder / ".DS_Store").write_bytes(bytes(6148))
    (root / "data" / ".ipynb_checkpoints").mkdir()
    (root / "data" / ".ipynb_checkpoints" / "file-000.parquet").write_bytes(b"x")
    return root


@pytest.mark.parametrize("hashed", [True, False])
def test_check_passes_and_says_what_it_ignored(
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


def _train(root: Path, new: Path) -> int:
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


@pytest.mark.parametrize("read", [_train, _info, _repair, _merge, _resume])
def test_every_reader_finds_the_episodes(
    read: Callable[[Path, Path], int], from_mac: Path, tmp_path: Path
) -> None:
    assert read(from_mac, tmp_path / "new") == 6
