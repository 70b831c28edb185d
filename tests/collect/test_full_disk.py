"""A real file system that is too small."""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from egovcp.data import open_dataset
from egovcp.data.committer import work_folder
from egovcp.data.metadata import verify_hashes
from egovcp_collect.collect import main

_FLAGS = (
    "--task=ball",
    "--env.controller=stance",
    "--env.ball_episode.ticks=6",
    "--env.ball_episode.event_ticks=[0,1]",
    "--shard_episodes=4",
    "--num_envs=4",
    "--num_workers=1",
    "--resume",
    "--episodes=80",
)


def _mount(folder: Path, *options: str) -> bool:
    command = ["mount", "-t", "tmpfs", *options, "none", str(folder)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Path]:
    """Too few megabytes for eighty episodes; how many fit depends on who is first."""
    folder = tmp_path / "small"
    folder.mkdir()
    if os.geteuid() != 0 or not _mount(folder, "-o", "size=2m"):
        pytest.skip("only the superuser may mount a small file system")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)  # a killed worker may linger


def test_it_stops_and_goes_on_when_there_is_room(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = small / "ball"
    assert main([*_FLAGS, f"--dataset.root={root}"]) == 5
    assert "No space left on device" in capsys.readouterr().err.splitlines()[-1]
    kept = _digests(root) if root.exists() else []
    sealed = [int(path.name[:9]) for path in (work_folder(root) / "sealed").glob("*.arrow")]
    assert len(kept) + len(sealed) >= 4
    assert _mount(small, "-o", "remount,size=32m")
    assert main([*_FLAGS, f"--dataset.root={root}"]) == 0
    everything = _digests(root)
    assert len(everything) == 80
    assert everything[: len(kept)] == kept


def _digests(root: Path) -> list[str]:
    verify_hashes(root)
    return [episode.digest() for episode in open_dataset(root)]
