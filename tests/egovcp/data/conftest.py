"""Synthetic episodes, a small dataset on disk, and a disk that fails."""

import errno
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    Episode,
    Provenance,
    dataset_files,
)
from egovcp.testing import random_episode

type MakeEpisode = Callable[..., Episode]


@pytest.fixture(scope="session")
def make_episode() -> MakeEpisode:
    return random_episode


@pytest.fixture(scope="session")
def episodes() -> list[Episode]:
    """Six episodes of two tasks and several lengths; two of them end in a fall."""
    shapes = [(12, 12), (7, 12), (12, 12), (1, 12), (20, 20), (12, 12)]
    tasks = ["ball", "wall"]
    return [
        random_episode(i, length, limit, tasks[i % 2]) for i, (length, limit) in enumerate(shapes)
    ]


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode]) -> Path:
    """A dataset of the six episodes; tests must not change it."""
    root = tmp_path_factory.mktemp("data") / "six"
    with DatasetWriter(root, Provenance("stance-1", seed=0, command="collect")) as writer:
        for episode in episodes:
            writer.add(episode)
    return root


@pytest.fixture(scope="session")
def reader(dataset_root: Path) -> DatasetReader:
    return DatasetReader.open(DatasetConfig(root=str(dataset_root)))


class Disk:
    """Every write, flush, rename and link of `egovcp.data` goes through it.

    Counts operations and bytes; fails at the ``fail_at``-th operation, or beyond ``room``.
    """

    def __init__(self, fail_at: int | None = None, room: int | None = None) -> None:
        self.fail_at = fail_at
        self.room = room
        self.operations = 0
        self.bytes = 0

    def operate(self, name: object) -> None:
        self.operations += 1
        if self.operations == self.fail_at:
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(name))

    def fill(self, size: int, name: object) -> None:
        self.bytes += size
        if self.room is not None and self.bytes > self.room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(name))

    def install(self, monkeypatch: pytest.MonkeyPatch) -> "Disk":
        """Put the disk between `egovcp.data.dataset_files` and the real one."""
        monkeypatch.setattr(
            dataset_files, "open_new", lambda path: io.BufferedWriter(_File(self, path))
        )
        for name in ("sync", "rename", "link", "exchange"):
            monkeypatch.setattr(dataset_files, name, self._counted(getattr(dataset_files, name)))
        return self

    def _counted(self, function: Any) -> Any:
        def counted(*paths: Path) -> None:
            self.operate(paths[0])
            function(*paths)

        return counted


class _File(io.FileIO):
    """What lies below a buffer: each write is one of the system's."""

    def __init__(self, disk: Disk, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        disk.operate(path)
        super().__init__(path, "xb")
        self._disk = disk

    def write(self, content: Any) -> int:
        self._disk.operate(self.name)
        self._disk.fill(len(memoryview(content).cast("B")), self.name)
        return super().write(content)


type MakeDisk = Callable[..., Disk]


@pytest.fixture(scope="session")
def make_disk() -> MakeDisk:
    return Disk
