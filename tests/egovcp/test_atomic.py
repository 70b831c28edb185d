"""Files are complete or absent, and others may read them if the umask says so."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from egovcp.artefact import FILES, save_artefact
from egovcp.atomic import write_json, write_text
from egovcp.plan import PlannerConfig
from egovcp.testing import toy_model


def test_json_is_complete_or_absent(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    assert json.loads(path.read_text()) == {"a": 1}
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 1}


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    write_text(tmp_path / "a", "old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space"):
        write_text(tmp_path / "a", "new")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "old"}


def _write_policy(folder: Path) -> None:
    save_artefact(folder / "policy", toy_model(), PlannerConfig(), {"controller_id": "a"})
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
