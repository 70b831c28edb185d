"""Symbolic links, empty folders and mount points as the root of a dataset."""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    Episode,
    Provenance,
    dataset_files,
)
from egovcp.data.committer import open_committer, work_folder
from egovcp.data.staging import encode
from egovcp.errors import EnvironmentFailure, UsageError
from tests.support.limited import run_limited

_RUN = Provenance("stance-1", seed=0, command="collect")


def _write(root: Path, episodes: list[Episode]) -> None:
    with DatasetWriter(root, _RUN) as writer:
        for episode in episodes:
            writer.add(episode)


def _collect(root: Path, episodes: list[Episode], resume: bool = False) -> None:
    """Add those episodes that the dataset does not have yet."""
    with open_committer(root, _RUN, 2, (lambda provenance: None) if resume else None) as committer:
        for number in committer.missing(len(episodes)):
            committer.staging.put(number, encode(episodes[number]))
            committer.mark_staged(number)
        committer.commit()


def _size(root: Path) -> int:
    return len(DatasetReader.open(DatasetConfig(root=str(root))))


def test_resume_through_a_link_extends_the_real_dataset(
    tmp_path: Path, episodes: list[Episode]
) -> None:
    real, link = tmp_path / "real", tmp_path / "elsewhere" / "link"
    link.parent.mkdir()
    link.symlink_to(real)
    _collect(real, episodes[:2])
    for count in (3, 5):  # an incomplete shard first, so that the second resume reads it back
        _collect(link, episodes[:count], resume=True)
    assert link.is_symlink()
    assert _size(real) == 5
    assert [path.name for path in link.parent.iterdir()] == ["link"]
    assert {path.name for path in tmp_path.iterdir()} == {"real", "elsewhere"}


@pytest.mark.parametrize(("first", "second"), [("real", "link"), ("link", "real")])
def test_a_link_and_its_target_share_one_lock(
    tmp_path: Path, episodes: list[Episode], first: str, second: str
) -> None:
    (tmp_path / "link").symlink_to("real")
    _collect(tmp_path / "real", episodes[:1])

    def agree(provenance: Provenance) -> None:
        """Nothing to compare."""

    with (
        open_committer(tmp_path / first, _RUN, 2, agree),
        pytest.raises(EnvironmentFailure, match="real is being written by process"),
        open_committer(tmp_path / second, _RUN, 2, agree),
    ):
        pass
    assert work_folder(tmp_path / "link") == work_folder(tmp_path / "real")


@pytest.mark.parametrize("write", [_write, _collect])
def test_a_link_to_an_absent_folder(
    tmp_path: Path, episodes: list[Episode], write: Callable[[Path, list[Episode]], None]
) -> None:
    (tmp_path / "link").symlink_to("disk/real")
    write(tmp_path / "link", episodes[:2])
    assert (tmp_path / "link").is_symlink()
    assert _size(tmp_path / "disk" / "real") == 2


def test_a_loop_of_links_is_refused(tmp_path: Path, episodes: list[Episode]) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(UsageError, match="a is a loop of symbolic links; remove it"):
        _write(tmp_path / "a", episodes[:1])


@pytest.mark.parametrize("write", [_write, _collect])
def test_an_empty_folder_is_a_root(
    tmp_path: Path, episodes: list[Episode], write: Callable[[Path, list[Episode]], None]
) -> None:
    root = tmp_path / "d"
    root.mkdir()
    write(root, episodes[:2])
    assert _size(root) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


def test_resume_in_an_empty_folder_starts_a_collection(
    tmp_path: Path, episodes: list[Episode]
) -> None:
    (tmp_path / "d").mkdir()
    _collect(tmp_path / "d", episodes[:2], resume=True)
    assert _size(tmp_path / "d") == 2


def test_a_folder_that_is_not_empty_is_refused(tmp_path: Path, episodes: list[Episode]) -> None:
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "notes.txt").write_text("mine")
    for write in (_write, _collect):
        with pytest.raises(UsageError, match="exists already"):
            write(tmp_path / "d", episodes[:1])
    assert [path.name for path in (tmp_path / "d").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("write", [_write, _collect])
def test_files_of_another_program_are_not_replaced(
    tmp_path: Path,
    episodes: list[Episode],
    write: Callable[[Path, list[Episode]], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root, rename = tmp_path / "d", dataset_files.rename

    def write_first(source: Path, target: Path) -> None:
        if target == root:
            root.mkdir()
            (root / "notes.txt").write_text("mine")
        rename(source, target)

    monkeypatch.setattr(dataset_files, "rename", write_first)
    with pytest.raises(UsageError, match="no longer empty"):
        write(root, episodes[:1])
    assert [path.name for path in root.iterdir()] == ["notes.txt"]


# mount points


@contextmanager
def _mounted(root: Path, kind: str) -> Iterator[None]:
    """A mount at ``root``, for this process alone; raises OSError where that is not permitted."""
    os.unshare(os.CLONE_NEWNS)
    subprocess.run(["mount", "--make-rprivate", "/"], check=True)
    what = ["--bind", str(root)] if kind == "bind" else ["-t", "tmpfs", "none"]
    subprocess.run(["mount", *what, str(root)], check=True)
    yield


_NOT_PERMITTED = 99


def _in_mount(root: Path, kind: str, function: Callable[[], None]) -> None:
    """Call the function in a child that has a mount at ``root``, or skip the test."""

    def child() -> int:
        try:
            with _mounted(root, kind):
                function()
        except (PermissionError, FileNotFoundError, subprocess.CalledProcessError):
            return _NOT_PERMITTED
        return 0

    result = run_limited(child, seconds=60)
    if result.exit_code == _NOT_PERMITTED:
        pytest.skip("mounting is not permitted here")
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("write", [_write, _collect])
def test_an_empty_mount_point_is_refused_before_any_write(
    tmp_path: Path,
    episodes: list[Episode],
    write: Callable[[Path, list[Episode]], None],
) -> None:
    root = tmp_path / "mnt"
    root.mkdir()

    def refused() -> None:
        with pytest.raises(EnvironmentFailure, match=r"is a mount point; .*mnt/dataset"):
            write(root, episodes[:1])
        write(root / "dataset", episodes[:1])
        assert _size(root / "dataset") == 1

    _in_mount(root, "tmpfs", refused)
    assert [path.name for path in tmp_path.iterdir()] == ["mnt"]


def test_resume_in_a_bind_mount_loses_nothing(tmp_path: Path, episodes: list[Episode]) -> None:
    root = tmp_path / "mnt"
    _collect(root, episodes[:1])

    def refused() -> None:
        with pytest.raises(EnvironmentFailure, match="is a mount point"):
            _collect(root, episodes[:2], resume=True)
        assert _size(root) == 1

    _in_mount(root, "bind", refused)
    assert {path.name for path in tmp_path.iterdir()} == {"mnt", ".mnt.collect"}


def test_a_mount_point_is_refused(mount_point: Path, episodes: list[Episode]) -> None:
    for write in (_write, _collect):
        with pytest.raises(EnvironmentFailure, match="is a mount point"):
            write(mount_point, episodes[:1])


@pytest.mark.parametrize("number", [errno.EBUSY, errno.EXDEV])
def test_a_root_that_cannot_be_renamed_loses_nothing(
    tmp_path: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def busy(one: Path, other: Path) -> None:
        raise OSError(number, os.strerror(number), str(one))

    root = tmp_path / "d"
    _collect(root, episodes[:1])
    with monkeypatch.context() as patch:
        patch.setattr(dataset_files, "exchange", busy)
        with pytest.raises(EnvironmentFailure, match=f"{root} cannot be renamed"):
            _collect(root, episodes[:2], resume=True)
    assert _size(root) == 1
    with open_committer(root, _RUN, 2, lambda provenance: None) as committer:
        assert committer.missing(2) == []  # what was simulated is still sealed
        committer.commit()
    assert _size(root) == 2


def test_a_failed_exchange_by_renames_restores_the_dataset(
    tmp_path: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, rename = tmp_path / "d", dataset_files.rename

    def unsupported(one: Path, other: Path) -> None:
        raise OSError(errno.EINVAL, "not here")

    def failing(source: Path, target: Path) -> None:
        if source.name == "next" and target == root:
            raise OSError(errno.EIO, "disk failure")
        rename(source, target)

    _collect(root, episodes[:1])
    with monkeypatch.context() as patch:
        patch.setattr(dataset_files, "exchange", unsupported)
        patch.setattr(dataset_files, "rename", failing)
        with pytest.raises(OSError, match="disk failure"):
            _collect(root, episodes[:2], resume=True)
    assert _size(root) == 1


def test_folders_beside_the_data_are_flushed_in_the_next_version(
    tmp_path: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, sync, synced = tmp_path / "d", dataset_files.sync, set[str]()
    _collect(root, episodes[:1])
    (root / "assets").mkdir()
    (root / "assets" / "plot.png").write_bytes(b"plot")

    def recorded(path: Path) -> None:
        synced.add(path.name)
        sync(path)

    monkeypatch.setattr(dataset_files, "sync", recorded)
    _collect(root, episodes[:2], resume=True)
    assert (root / "assets" / "plot.png").read_bytes() == b"plot"
    assert "plot.png" in synced


def test_exchange_without_renameat2_is_not_supported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ctypes.CDLL", lambda *args, **options: object())
    with pytest.raises(OSError, match="needs renameat2") as caught:
        dataset_files.exchange(tmp_path / "a", tmp_path / "b")
    assert caught.value.errno == errno.ENOSYS


def test_hard_links_across_file_systems_become_copies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other_device(source: Path, target: Path) -> None:
        raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))

    (tmp_path / "a").write_text("content")
    monkeypatch.setattr(os, "link", other_device)
    dataset_files.link(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_text() == "content"
