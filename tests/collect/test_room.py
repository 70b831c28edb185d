"""A disk that is clearly too small is told from the start."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from egovcp import spec
from egovcp.data.staging import StagedEpisode, encode
from egovcp.errors import EnvironmentFailure
from egovcp.sim.config import EnvConfig
from egovcp.sim.scenario import Scenario
from egovcp.testing import random_episode
from egovcp_collect import room
from egovcp_collect.collect import main
from egovcp_collect.crew import Crew

_SCENARIOS = [Scenario(task, 0, i) for i, task in enumerate((*spec.TASKS, "ball"))]


def _free(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=free))


def test_a_sealed_frame_is_as_large_as_it_is_taken_to_be() -> None:
    ticks = 100
    sealed = len(StagedEpisode.of(0, encode(random_episode(0, ticks))).payload)
    assert ticks * room.SEALED_FRAME_BYTES < sealed < 1.05 * ticks * room.SEALED_FRAME_BYTES


@pytest.mark.parametrize("shard", [1, 3, 100])
def test_what_is_needed_lies_between_all_compressed_and_none(shard: int) -> None:
    env = EnvConfig()
    raw = room.SEALED_FRAME_BYTES * sum(env.episode(s.task).ticks for s in _SCENARIOS)
    needed = room.least_bytes(_SCENARIOS, env, shard)
    assert room.LEAST_SHARE * raw < needed <= raw
    assert needed < room.least_bytes([*_SCENARIOS, _SCENARIOS[0]], env, shard)


def test_just_enough_is_enough(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = EnvConfig()
    needed = room.least_bytes(_SCENARIOS, env, 2)
    _free(monkeypatch, needed)
    room.require_room(tmp_path, _SCENARIOS, env, 2)
    _free(monkeypatch, needed - 1)
    with pytest.raises(EnvironmentFailure, match=rf"{needed} bytes.*{needed - 1} bytes are free"):
        room.require_room(tmp_path, _SCENARIOS, env, 2)


def test_a_collection_that_does_not_fit_does_not_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Crew, "__enter__", lambda crew: pytest.fail("began"))
    _free(monkeypatch, 10_000_000)
    flags = [f"--dataset.root={tmp_path / 'ball'}", "--episodes=10000"]
    assert main(flags) == 5
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "10000 episodes need at least" in line
    assert "10000000 bytes are free" in line
    assert list(tmp_path.iterdir()) == []
