"""Training windows per second of the two samplers and of LeRobot's dataset.

The same dataset and windows of the same length, batch by batch, with one thread:

* ``lerobot``: `LeRobotDataset` with `delta_timestamps` for every feature of a window, items at
  random frames, collated by torch;
* ``ram``: `egovcp.data.InMemorySampler`, all episodes in memory;
* ``stream``: `egovcp.data.StreamingSampler`, episodes read from the disk through a shuffle window.

Cases are interleaved; a ratio is the median of the ratios of the rounds. Rates use CPU time, which
reduces the effect of other programs. The dataset is in the page cache, so decoding is measured.

``hub_ratio`` compares, by wall clock, an epoch streamed from a Hub on this machine with an empty
cache with the same epoch from the disk.

    python benchmarks/loader.py --root data/wall
"""

from __future__ import annotations

import contextlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from report import parser, publish
from torch.utils.data import default_collate
from writer import PROVENANCE, make_episode, write_dataset

from egovcp import spec
from egovcp.data import (
    DatasetReader,
    DatasetWriter,
    EpisodeIndex,
    EpisodeStore,
    InMemorySampler,
    SamplerConfig,
    ShuffleConfig,
    StreamingSampler,
    open_dataset,
)
from egovcp.dataset_options import DatasetConfig
from egovcp.hub import Content, Publication, RetryPolicy
from egovcp.hub import publish as publish_dataset

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # for tests.support

from tests.support.hub import redirect_hub  # noqa: E402

BATCH = 16
HUB_REPO = "me/bench"
HUB_EPISODES_PER_FILE = 25


def lerobot_batches(root: Path, length: int) -> Iterator[object]:
    """Batches of windows that begin at random frames."""
    steps = [i / spec.PLANNER_HZ for i in range(length)]
    dataset = LeRobotDataset(
        HUB_REPO, root=root, delta_timestamps=dict.fromkeys(spec.FEATURES, steps)
    )
    rng = np.random.default_rng(0)
    while True:
        rows = rng.integers(len(dataset), size=BATCH).tolist()
        yield default_collate([dataset[row] for row in rows])


def windows_per_second(batches: Iterator[object], seconds: float) -> float:
    """Windows per second of processor time, over at least so many seconds of it."""
    count, start = 0, time.process_time()
    while (passed := time.process_time() - start) < seconds:
        next(batches)
        count += BATCH
    return count / passed


def compare(
    index: EpisodeIndex, length: int, rounds: int, shuffle: ShuffleConfig
) -> dict[str, object]:
    """Rates, and the ratios of both samplers to LeRobot."""
    config = SamplerConfig(batch_size=BATCH, length=length)
    (reader,) = index.readers
    cases: dict[str, Callable[[], Iterator[object]]] = {
        "lerobot": lambda: lerobot_batches(reader.root, length),
        "ram": lambda: InMemorySampler(EpisodeStore.read(index), config),
        "stream": lambda: StreamingSampler(index, config, shuffle=shuffle),
    }
    streams = {name: make() for name, make in cases.items()}
    for stream in streams.values():
        next(stream)
    found = [
        {name: windows_per_second(stream, 1.0) for name, stream in streams.items()}
        for _ in range(rounds)
    ]
    metrics: dict[str, object] = {
        "episodes": len(index),
        "frames": index.num_frames,
        "length": length,
        "batch": BATCH,
        "shuffle_episodes": shuffle.episodes,
        "shuffle_reuse": shuffle.reuse,
    }
    metrics |= {f"{k}_windows_per_s": statistics.median(r[k] for r in found) for k in streams}
    for name in ("ram", "stream"):
        metrics[f"{name}_ratio"] = statistics.median(r[name] / r["lerobot"] for r in found)
    return metrics


def measure_hub_epoch(folder: Path, episodes: int, length: int, rounds: int) -> dict[str, object]:
    """Windows per second of an epoch from the Hub and from the disk, and their ratio.

    Each epoch from the Hub begins with an empty cache, so that files are downloaded while they are
    read. The first turn warms up and does not count.
    """
    config, shuffle = SamplerConfig(batch_size=BATCH, length=length), ShuffleConfig(32)
    root = folder / "local"
    with DatasetWriter(root, PROVENANCE, HUB_EPISODES_PER_FILE) as writer:
        for number in range(episodes):
            writer.add(make_episode(number, 150))
    files = [path for path in root.rglob("*") if path.is_file()]
    contents = {path.relative_to(root).as_posix(): Content(path) for path in files}
    with serving(folder / "hub") as endpoint:
        with redirect_hub(endpoint, folder / "home"):
            publish_dataset(Publication(HUB_REPO, contents, "a benchmark"), RetryPolicy())
        rows = []
        for _ in range(rounds + 1):
            disk = epoch_rate(DatasetReader.open(DatasetConfig(root=str(root))), config, shuffle)
            with tempfile.TemporaryDirectory() as home, redirect_hub(endpoint, Path(home)):
                reader = DatasetReader.on_demand(DatasetConfig(repo_id=HUB_REPO))
                rows.append((disk, epoch_rate(reader, config, shuffle)))
    return {
        "disk_epoch_windows_per_s": statistics.median(disk for disk, _ in rows[1:]),
        "hub_epoch_windows_per_s": statistics.median(hub for _, hub in rows[1:]),
        "hub_ratio": statistics.median(hub / disk for disk, hub in rows[1:]),
    }


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[str]:
    """Run a fake Hub in a process; gives its address."""
    command = [sys.executable, "-m", "tests.support.hub", "--root", folder]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as hub:
        assert hub.stdout is not None
        try:
            yield hub.stdout.readline().split("HF_ENDPOINT=")[1].split()[0]
        finally:
            hub.terminate()


def epoch_rate(reader: DatasetReader, config: SamplerConfig, shuffle: ShuffleConfig) -> float:
    """Windows per second of wall clock of an epoch."""
    index = EpisodeIndex.of([reader])
    stream = StreamingSampler(index, config, shuffle=shuffle, checked=not reader.is_remote)
    batches = max(1, int(index.num_frames * shuffle.reuse / config.length / config.batch_size))
    start = time.perf_counter()
    for _ in range(batches):
        next(stream)
    return batches * config.batch_size / (time.perf_counter() - start)


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--root", type=Path, help="dataset to read instead of a synthetic one")
    options.add_argument(
        "--episodes", type=int, default=100, help="episodes of the synthetic dataset"
    )
    options.add_argument("--length", type=int, default=32, help="steps per window")
    options.add_argument("--shuffle_episodes", type=int, default=128, help="episodes in memory")
    options.add_argument(
        "--reuse", type=float, default=1.0, help="mean number of times a step in memory is sampled"
    )
    options.add_argument(
        "--hub_episodes",
        type=int,
        default=400,
        help="episodes streamed from the fake Hub; 0 skips this case",
    )
    args = options.parse_args()
    torch.set_num_threads(1)
    metrics: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        root = args.root or home / "dataset"
        if args.root is None:
            write_dataset(root, [make_episode(i, 150) for i in range(args.episodes)])
        if args.hub_episodes:  # first: measured by wall clock, without other files in memory
            metrics |= measure_hub_epoch(
                home / "remote", args.hub_episodes, args.length, args.rounds
            )
        index = EpisodeIndex.of([open_dataset(root)], "train")
        shuffle = ShuffleConfig(args.shuffle_episodes, args.reuse)
        metrics |= compare(index, args.length, args.rounds, shuffle)
        publish(metrics, args.json)


if __name__ == "__main__":
    main()
