"""Output folders of the commands that write a new dataset."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from egovcp.data import DatasetConfig, DatasetReader
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
