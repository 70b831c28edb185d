"""Files are complete or absent, and others may read them if the umask says so."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from egovcp.artifact import FILES, save_artifact
from egovcp.files import removed_on_error, write_bytes, write_json, write_text
from egovcp.plan import PlannerConfig
from egovcp.testing import toy_model


def test_json_is_written_completely_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    assert json.loads(path.read_text()) == {"a": 1}
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 1}


def test_failed_write_keeps_the_old_file_and_leaves_nothing_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.bin"
    write_bytes(path, b"old")

    def fail(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def _interrupt(path: Path) -> None:
    with removed_on_error(path):
        raise KeyboardInterrupt


def test_a_hard_link_keeps_the_old_content(tmp_path: Path) -> None:
    path, link = tmp_path / "README.md", tmp_path / "older"
    path.write_text("first")
    link.hardlink_to(path)
    write_text(path, "second")
    assert (path.read_text(), link.read_text()) == ("second", "first")


def test_temporary_file_folder_or_link_is_removed_and_nothing_else(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "file").touch()
    (tmp_path / "file").touch()
    (tmp_path / "folder" / "inner").mkdir(parents=True)
    (tmp_path / "link").symlink_to(kept)
    for name in ("file", "folder", "link", "absent"):
        with pytest.raises(KeyboardInterrupt):
            _interrupt(tmp_path / name)
    assert list(tmp_path.iterdir()) == [kept]
    assert (kept / "file").exists()


def _write_policy(folder: Path) -> None:
    save_artifact(folder / "policy", toy_model(), PlannerConfig(), {"controller_id": "a"})
    assert {path.name for path in (folder / "policy").iterdir()} == set(FILES)


@pytest.mark.parametrize("umask", [0o022, 0o002, 0o077])
@pytest.mark.parametrize(
    "write",
    [
        _write_policy,
        lambda folder: write_json(folder / "a.json", {}),
    ],
)
def test_modes_follow_the_umask(tmp_path: Path, write: Callable[[Path], None], umask: int) -> None:
    previous = os.umask(umask)
    try:
        write(tmp_path)
    finally:
        os.umask(previous)
    modes = {path.stat().st_mode & 0o777 for path in tmp_path.rglob("*") if path.is_file()}
    assert modes == {0o666 & ~umask}
