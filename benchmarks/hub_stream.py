"""An epoch streamed from a Hub on the same machine, beside the same epoch from the disk."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from writer import PROVENANCE, make_episode

from egovcp.cli import DatasetConfig
from egovcp.data import (
    DatasetReader,
    DatasetWriter,
    EpisodeIndex,
    SamplerConfig,
    ShuffleConfig,
    StreamingSampler,
)
from egovcp.hub import Content, Publication, RetryPolicy, publish

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # for tests.support

from tests.support.hub import in_this_process  # noqa: E402

_REPO = "me/bench"
_EPISODES_PER_FILE = 25


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[str]:
    """A fake Hub in a process of its own; its address."""
    command = [sys.executable, "-m", "tests.support.hub", "--root", folder]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as hub:
        assert hub.stdout is not None
        try:
            yield hub.stdout.readline().split("HF_ENDPOINT=")[1].split()[0]
        finally:
            hub.terminate()


def epoch_rates(
    folder: Path, episodes: int, config: SamplerConfig, shuffle: ShuffleConfig, rounds: int
) -> list[dict[str, float]]:
    """Windows per second of wall clock of an epoch from the disk and from the Hub, in turns.

    Each time from the Hub begins with an empty cache: every file comes while it is being read. A
    first turn, in which libraries are loaded and the system finds memory, does not count.
    """
    root = folder / "local"
    with DatasetWriter(root, PROVENANCE, _EPISODES_PER_FILE) as writer:
        for number in range(episodes):
            writer.add(make_episode(number, 150))
    files = [path for path in root.rglob("*") if path.is_file()]
    contents = {path.relative_to(root).as_posix(): Content(path) for path in files}
    with serving(folder / "hub") as endpoint:
        with in_this_process(endpoint, folder / "home"):
            publish(Publication(_REPO, contents, "a benchmark"), RetryPolicy())
        return [_round(root, endpoint, config, shuffle) for _ in range(rounds + 1)][1:]


def _round(
    root: Path, endpoint: str, config: SamplerConfig, shuffle: ShuffleConfig
) -> dict[str, float]:
    disk = _epoch(DatasetReader.open(DatasetConfig(root=str(root))), config, shuffle)
    with tempfile.TemporaryDirectory() as home, in_this_process(endpoint, Path(home)):
        hub = _epoch(DatasetReader.on_demand(DatasetConfig(repo_id=_REPO)), config, shuffle)
    return {"disk": disk, "hub": hub}


def _epoch(reader: DatasetReader, config: SamplerConfig, shuffle: ShuffleConfig) -> float:
    index = EpisodeIndex.of([reader])
    stream = StreamingSampler(index, config, shuffle=shuffle, checked=not reader.is_remote)
    batches = int(index.num_frames * shuffle.reuse / config.length / config.batch_size)
    start = time.perf_counter()
    for _ in range(batches):
        next(stream)
    return batches * config.batch_size / (time.perf_counter() - start)
