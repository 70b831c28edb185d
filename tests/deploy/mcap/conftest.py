"""A dataset of two episodes, and recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.data import DatasetReader, DatasetWriter, Provenance, open_dataset
from egovcp.log.mcap import McapSink
from egovcp.log.tick import RunInfo, Tick
from egovcp.rollouts import CONTROLLER, ticks_of
from egovcp.testing import random_episode

type Record = Callable[..., Path]

INFO = RunInfo("ball", seed=3, episode=7, hashes={CONTROLLER: "stance-1"})


@pytest.fixture
def dataset(tmp_path: Path) -> DatasetReader:
    """One episode that falls and one whose time is up."""
    provenance = Provenance("stance-1", seed=0, config={"env": {"camera": {"vertical_fov": 1.0}}})
    with DatasetWriter(tmp_path / "data", provenance) as writer:
        writer.add(random_episode(0, length=9, time_limit=12))
        writer.add(random_episode(1, length=7))
    return open_dataset(tmp_path / "data")


@pytest.fixture
def record(tmp_path: Path) -> Record:
    """``record(name, ...)`` writes a rollout of 8 ticks without those in ``missing``."""

    def record(
        name: str = "a.mcap",
        info: RunInfo = INFO,
        missing: tuple[int, ...] = (),
        keep: Callable[[Tick], Tick] = lambda tick: tick,
        number: int = 0,
    ) -> Path:
        sink = McapSink(tmp_path / name)
        sink.open(info)
        for tick in ticks_of(random_episode(number, length=8)):
            if tick.index not in missing:
                sink.write(keep(tick))
        sink.close()
        return tmp_path / name

    return record


@pytest.fixture
def fallen() -> Callable[[Tick], Tick]:
    """A run that ends with a fall at tick 5, and is recorded for longer."""
    return lambda tick: replace(tick, terminated=tick.index >= 5, truncated=False)
