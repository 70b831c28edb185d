"""Too little disk space: refused before work starts, or resumed after the disk was full."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from egovcp.data import open_dataset
from egovcp.data.committer import work_folder
from egovcp.data.episode import frame_bytes
from egovcp.data.metadata import verify_hashes
from egovcp.data.staging import encode, to_bytes
from egovcp.errors import EnvironmentFailure
from egovcp.robot_spec import G1
from egovcp.sim.config import EnvConfig
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks import task_names
from egovcp.testing import random_episode
from egovcp_collect import collect
from egovcp_collect.collect import main
from egovcp_collect.worker_pool import WorkerPool

_SCENARIOS = [Scenario(task, 0, i) for i, task in enumerate((*task_names(training=True), "ball"))]


def _free(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=free))


def test_frame_bytes_match_a_staged_episode() -> None:
    raw = 100 * frame_bytes(G1)
    assert raw < to_bytes(encode(random_episode(0, 100))).size < 1.05 * raw


@pytest.mark.parametrize("shard", [1, 3, 100])
def test_needed_bytes_lie_between_compressed_and_uncompressed_size(shard: int) -> None:
    env = EnvConfig()
    raw = frame_bytes(G1) * sum(env.episode(s.task).ticks for s in _SCENARIOS)
    needed = collect.min_bytes(_SCENARIOS, env, shard)
    assert collect.MIN_COMPRESSED_SHARE * raw < needed <= raw
    assert needed < collect.min_bytes([*_SCENARIOS, _SCENARIOS[0]], env, shard)


def test_exactly_enough_space_is_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = EnvConfig()
    needed = collect.min_bytes(_SCENARIOS, env, 2)
    _free(monkeypatch, needed)
    collect.require_disk_space(tmp_path, _SCENARIOS, env, 2)
    _free(monkeypatch, needed - 1)
    with pytest.raises(EnvironmentFailure, match=r"0\.0 GB below .*, where 0\.0 GB are free"):
        collect.require_disk_space(tmp_path, _SCENARIOS, env, 2)


def test_a_collection_that_does_not_fit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(WorkerPool, "poll", lambda pool: pytest.fail("began"))
    _free(monkeypatch, 360_000_000)
    flags = [f"--dataset.root={tmp_path / 'ball'}", "--episodes=10000"]
    assert main(flags) == 5
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "10000 episodes need at least" in line
    assert "0.4 GB are free" in line
    assert list(tmp_path.iterdir()) == []


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
    """A file system that is too small for eighty episodes."""
    folder = tmp_path / "small"
    folder.mkdir()
    if os.geteuid() != 0 or not _mount(folder, "-o", "size=2m"):
        pytest.skip("mounting a file system needs root")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)  # a killed worker may linger


@pytest.mark.slow
def test_a_collection_resumes_after_the_disk_was_full(
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
