"""A small sound dataset of two files, and ways to copy and run."""

import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from egovcp import spec
from egovcp.data import DatasetWriter, Episode, Provenance
from tests.support.environments import CountingEnv
from tests.support.lerobot_datasets import KINDS, write_dataset

type MakeEpisode = Callable[..., Episode]

COLLECTED = Provenance("stance-1", seed=5, command="collect", config={"eta": 0.3})
LENGTHS = (12, 7, 12, 5, 9, 12)


def walk(number: int, length: int, time_limit: int = 12, task: str = "ball") -> Episode:
    """An episode of the counting environment, whose commands line up with its actions; it falls
    if ``length`` is less than ``time_limit``."""
    rng, env = np.random.default_rng(number), CountingEnv(1)
    seen, steps, states = env.reset([length]), [], []
    for action in rng.uniform(-0.9, 0.9, (length, 1, 7)):
        states.append(seen.state[0])
        steps.append(env.step(action))
        seen = steps[-1].observation
    last = np.arange(length) == length - 1
    return Episode(
        depth=rng.integers(280, 4000, (length, spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16),
        state=np.stack(states),
        action=np.concatenate([s.sent_action for s in steps]).astype(np.float32),
        reward=rng.normal(size=length).astype(np.float32),
        done=last,
        success=rng.random(length) < 0.5,
        truncated=last & (length == time_limit),
        task=task,
        time_limit=time_limit,
        metadata={"seed": 5, "episode": number},
    )


def write(root: Path, numbers: list[int], provenance: Provenance | None = None) -> Path:
    """A dataset of the walks with these numbers, tasks in turn, three episodes per file."""
    with DatasetWriter(root, provenance or COLLECTED, shard_episodes=3) as writer:
        for n in numbers:
            writer.add(walk(n, LENGTHS[n % 6], task="wall" if n % 2 else "ball"))
    return root


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes; tests must not change it."""
    return write(tmp_path_factory.mktemp("sound") / "six", [*range(6)])


@pytest.fixture
def copy(sound: Path, tmp_path: Path) -> Path:
    """A copy of the sound dataset that a test may damage."""
    return Path(shutil.copytree(sound, tmp_path / "copy"))


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any look-up of a name, and any connection, fails the test."""

    def refuse(*args: object) -> None:
        raise AssertionError(f"the network was asked: {args}")

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.fixture(scope="session")
def others(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Datasets of many kinds that LeRobot wrote, by kind; tests must not change them."""
    folder = tmp_path_factory.mktemp("others")
    return {kind: write_dataset(folder / kind, kind) for kind in KINDS}
