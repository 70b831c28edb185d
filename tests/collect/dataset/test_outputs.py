"""Output folders of the commands that write a new dataset."""

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from egovcp.data import DatasetConfig, DatasetReader
from egovcp.errors import DataError
from egovcp_collect.dataset import edit, rewrite
from egovcp_collect.dataset.cli import main
from tests.support.hub import FakeHub

from .conftest import write

type Write = Callable[[Path, Path], int]


def _merge(sound: Path, output: Path) -> int:
    other = sound.with_name("other")
    if not other.exists():
        write(other, [6])
    return main(["merge", str(sound), str(other), f"--output_dir={output}"])


def _repair(sound: Path, output: Path) -> int:
    return main(["repair", str(sound), f"--output_dir={output}"])


def _pull(sound: Path, output: Path) -> int:
    flags = ["--network.attempts=1", "--network.timeout_s=20"]
    return main(["pull", "me/six", f"--output_dir={output}", *flags])


_WRITERS = pytest.mark.parametrize("command", [_merge, _repair, _pull])


@pytest.fixture
def published(hub: FakeHub, sound: Path) -> None:
    """The sound dataset is on the Hub as well."""
    assert main(["push", str(sound), "--repo_id=me/six"]) == 0


def _episodes(root: Path) -> int:
    return len(DatasetReader.open(DatasetConfig(root=str(root))))


@_WRITERS
@pytest.mark.usefixtures("published")
def test_a_link_is_followed_and_kept(command: Write, sound: Path, tmp_path: Path) -> None:
    for name, is_there in (("empty", True), ("new", False)):
        link, real = tmp_path / f"link-{name}", tmp_path / name
        link.symlink_to(real)
        if is_there:
            real.mkdir()
        assert command(sound, link) == 0
        assert link.is_symlink()
        assert _episodes(real) >= 6
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@_WRITERS
@pytest.mark.usefixtures("published")
def test_a_folder_with_content_is_refused(command: Write, sound: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    assert command(sound, tmp_path / "full") == 2
    assert os.listdir(tmp_path / "full") == ["notes.txt"]
    assert set(os.listdir(tmp_path)) <= {"full", "hub"}


@_WRITERS
@pytest.mark.usefixtures("published")
def test_a_mount_point_is_refused_before_work_starts(
    command: Write,
    sound: Path,
    mount_point: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    capsys.readouterr()
    assert command(sound, mount_point) == 5
    assert f"{mount_point} is a mount point" in capsys.readouterr().err
    assert not os.listdir(mount_point)


def test_a_report_may_lie_in_the_new_dataset(sound: Path, tmp_path: Path) -> None:
    output = tmp_path / "repaired"
    report = output / "report.json"
    assert main(["repair", str(sound), f"--output_dir={output}", f"--json={report}"]) == 0
    assert json.loads(report.read_text())["episodes"] == _episodes(output) == 6


def _fails(*args: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_new_dataset_outlives_an_output_that_cannot_be_written(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (edit, rewrite):
        monkeypatch.setattr(module, "echo", _fails)
    for command in ("repair", "delete --episodes=[0]", "split"):
        name, *flags = command.split()
        assert main([name, str(sound), f"--output_dir={tmp_path / name}", *flags]) == 5
    counts = [_episodes(tmp_path / name) for name in ("repair", "delete", "split/train")]
    assert counts == [6, 5, 5]


def test_a_split_that_failed_can_be_repeated(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["split", str(sound), f"--output_dir={tmp_path / 'parts'}"]
    write, written = edit._write, []

    def second_fails(reader: DatasetReader, kept: list[int], output: Path) -> dict[str, int]:
        if written:
            raise DataError("damaged")
        written.append(output)
        return write(reader, kept, output)

    with monkeypatch.context() as patch:
        patch.setattr(edit, "_write", second_fails)
        assert main(command) == 3
    assert not written[0].exists()
    assert main(command) == 0


@pytest.mark.parametrize(
    ("command", "code"), [("coverage --output_dir={}", 5), ("card --output={}/x.md", 2)]
)
def test_outputs_are_checked_before_the_statistics(
    command: str, code: int, sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egovcp_collect.dataset.coverage.compute_statistics", pytest.fail)
    monkeypatch.setattr("egovcp_collect.dataset.card.compute_statistics", pytest.fail)
    (tmp_path / "file").touch()
    name, flag = command.format(tmp_path / "file").split()
    assert main([name, str(sound), flag]) == code


@pytest.mark.parametrize("command", ["info", "check", "coverage", "repair", "delete", "split"])
def test_a_report_does_not_replace_a_file_of_the_dataset(
    command: str, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report, flags = copy / "meta" / "info.json", []
    if command in ("repair", "delete", "split"):
        flags = [f"--output_dir={tmp_path / 'new'}"]
    before = report.read_bytes()
    assert main([command, str(copy), f"--json={report}", *flags]) == 2
    assert "is part of the input" in capsys.readouterr().err
    assert report.read_bytes() == before


def test_a_card_does_not_replace_a_file_of_the_dataset(copy: Path) -> None:
    assert main(["card", str(copy), f"--output={copy / 'meta' / 'info.json'}"]) == 2
