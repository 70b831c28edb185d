"""Folders of runs that were killed are removed by the next run, and no others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from egovcp_deploy.live.run_folder import remove_stale, run_folder

_HOLD = """
import pathlib, signal, sys
from egovcp_deploy.live.run_folder import run_folder

with run_folder(pathlib.Path(sys.argv[1])) as folder:
    (folder / "link").touch()
    print(folder, flush=True)
    signal.pause()
"""


def _started(parent: Path) -> tuple[subprocess.Popen[str], Path]:
    command = [sys.executable, "-c", _HOLD, str(parent)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_the_folder_of_a_killed_run_is_removed_by_the_next(tmp_path: Path) -> None:
    process, left = _started(tmp_path)
    with run_folder(tmp_path):
        assert left.is_dir()  # alive
    process.kill()
    process.communicate()
    assert left.is_dir()
    with run_folder(tmp_path) as folder:
        assert list(tmp_path.iterdir()) == [folder]
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_run_of_this_user_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "lock").touch()
    (tmp_path / "egovcp-run-link").symlink_to(victim, target_is_directory=True)
    (tmp_path / "egovcp-run-empty").mkdir()  # without a lock: of no run
    foreign = tmp_path / "egovcp-run-foreign"
    foreign.mkdir()
    (foreign / "lock").touch()
    monkeypatch.setattr(os, "getuid", lambda: foreign.stat().st_uid + 1)
    remove_stale(tmp_path)
    monkeypatch.undo()
    assert victim.is_dir()
    assert foreign.is_dir()
    remove_stale(tmp_path)
    assert victim.is_dir()
    assert not foreign.exists()
    assert (tmp_path / "egovcp-run-empty").is_dir()
