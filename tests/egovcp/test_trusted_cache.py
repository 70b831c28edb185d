"""Cached files are read back only if no other user can have written them and their SHA-256
matches."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.trusted_cache import TrustedCache, user_cache_folder

NAME, CONTENT = "library.so", bytes(range(256)) * 40
OTHER_USER = 12345
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A cache folder that holds one file."""
    TrustedCache(tmp_path / "cache" / "egovcp").write(NAME, CONTENT)
    return tmp_path / "cache" / "egovcp"


def _read(folder: Path) -> bytes | None:
    return TrustedCache(folder).read(NAME)


def _flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def _link_elsewhere(file: Path) -> None:
    file.rename(file.parent.parent / "elsewhere.so")
    file.symlink_to(file.parent.parent / "elsewhere.so")


def _replace_by_fifo(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _give_away(file: Path) -> None:
    os.chown(file, OTHER_USER, OTHER_USER)


def _digest(file: Path) -> Path:
    return Path(f"{file}.sha256")


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda file: file.write_bytes(b""), id="empty"),
        pytest.param(lambda file: os.truncate(file, 5000), id="truncated"),
        pytest.param(_flip_a_bit, id="one bit"),
        pytest.param(_link_elsewhere, id="symbolic link"),
        pytest.param(_replace_by_fifo, id="FIFO"),
        pytest.param(lambda file: file.chmod(0o620), id="group-writable"),
        pytest.param(lambda file: file.chmod(0o602), id="world-writable"),
        pytest.param(lambda file: _digest(file).unlink(), id="no digest"),
        pytest.param(
            lambda file: _digest(file).write_text(f"{'0' * 64}  {NAME}\n"), id="wrong digest"
        ),
        pytest.param(_give_away, id="file of another user", marks=needs_root),
        pytest.param(
            lambda file: _give_away(_digest(file)), id="digest of another user", marks=needs_root
        ),
    ],
)
def test_a_damaged_file_is_not_read_and_can_be_replaced(
    damage: Callable[[Path], object], folder: Path
) -> None:
    assert _read(folder) == CONTENT
    damage(folder / NAME)
    assert _read(folder) is None
    TrustedCache(folder).write(NAME, CONTENT)
    assert _read(folder) == CONTENT
    assert len(list(folder.iterdir())) == 2, "temporary files were left"


def test_data_is_synchronised_before_the_rename(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    fsync, rename = os.fsync, os.rename
    monkeypatch.setattr(os, "fsync", lambda file: (calls.append("fsync"), fsync(file)))
    monkeypatch.setattr(os, "rename", lambda *a, **k: (calls.append("rename"), rename(*a, **k)))
    TrustedCache(folder).write(NAME, CONTENT)
    assert calls == ["fsync", "rename", "fsync", "rename", "fsync"]


def test_a_write_that_fails_leaves_the_older_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(file: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space"):
        TrustedCache(folder).write(NAME, b"newer")
    assert _read(folder) == CONTENT
    assert len(list(folder.iterdir())) == 2


def test_linked_parents_are_resolved(folder: Path, tmp_path: Path) -> None:
    """``~/.cache`` is often a link to a larger disk."""
    (tmp_path / "link").symlink_to(folder.parent)
    assert _read(tmp_path / "link" / "egovcp") == CONTENT


@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777])
def test_a_folder_that_others_can_write_to_is_refused(mode: int, folder: Path) -> None:
    for part in (folder, folder.parent):
        part.chmod(mode)
        with pytest.raises(EnvironmentFailure, match=rf"chmod go-w {part}, or set XDG_CACHE_HOME"):
            TrustedCache(folder)
        part.chmod(0o700)


def test_a_sticky_parent_is_trusted(folder: Path) -> None:
    folder.parent.chmod(0o1777)
    assert _read(folder) == CONTENT


def test_the_cache_folder_of_a_user(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for value in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert user_cache_folder() == tmp_path / ".cache" / "egovcp"
    monkeypatch.setenv("XDG_CACHE_HOME", "/elsewhere")
    assert user_cache_folder() == Path("/elsewhere/egovcp")
