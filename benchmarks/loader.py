"""Training windows per second: LeRobot's `delta_timestamps` against the two streams.

The same dataset and windows of the same length, batch by batch, one process each with one thread:

* ``lerobot``: `LeRobotDataset` with `delta_timestamps` for every feature that a window needs, items
  at random places, collated by torch;
* ``ram``: `egovcp.data.SequenceStream`, all episodes in memory;
* ``bounded``: `egovcp.data.BoundedStream`, episodes read from the disk through a shuffle window.

The cases take turns; ratios are medians of the ratios of one turn. Processor time counts, so that
other programs on the machine do not. The disk's pages are cached: this measures decoding.

    python benchmarks/loader.py --root data/wall
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from report import parser, publish
from torch.utils.data import default_collate
from writer import make_episode
from writer import writer as write

from egovcp import spec
from egovcp.data import (
    BoundedStream,
    EpisodeIndex,
    EpisodeStore,
    SequenceStream,
    ShuffleConfig,
    StreamConfig,
    open_dataset,
)

BATCH = 16


def lerobot(root: Path, length: int) -> Iterator[object]:
    """Batches of windows that begin at random frames."""
    steps = [i / spec.PLANNER_HZ for i in range(length)]
    dataset = LeRobotDataset(
        "me/bench", root=root, delta_timestamps=dict.fromkeys(spec.FEATURES, steps)
    )
    rng = np.random.default_rng(0)
    while True:
        rows = rng.integers(len(dataset), size=BATCH).tolist()
        yield default_collate([dataset[row] for row in rows])


def measured(batches: Iterator[object], seconds: float) -> float:
    """Windows per second of processor time, over at least so many seconds of it."""
    count, start = 0, time.process_time()
    while (passed := time.process_time() - start) < seconds:
        next(batches)
        count += BATCH
    return count / passed


def compare(root: Path, length: int, rounds: int, shuffle: ShuffleConfig) -> dict[str, object]:
    """The rates, and their ratios to LeRobot's."""
    index = EpisodeIndex.of([open_dataset(root)], "train")
    config = StreamConfig(batch_size=BATCH, length=length)
    cases: dict[str, Callable[[], Iterator[object]]] = {
        "lerobot": lambda: lerobot(root, length),
        "ram": lambda: SequenceStream(EpisodeStore.read(index), config),
        "bounded": lambda: BoundedStream(index, config, shuffle=shuffle),
    }
    streams = {name: make() for name, make in cases.items()}
    for stream in streams.values():
        next(stream)
    found = [{name: measured(s, 1.0) for name, s in streams.items()} for _ in range(rounds)]
    figures: dict[str, object] = {
        "episodes": len(index),
        "frames": index.num_frames,
        "window": length,
        "batch": BATCH,
        "shuffle_episodes": shuffle.episodes,
        "shuffle_reuse": shuffle.reuse,
    }
    for name in cases:
        figures[f"{name}_windows_per_s"] = statistics.median(row[name] for row in found)
        if name != "lerobot":
            figures[f"{name}_ratio"] = statistics.median(r[name] / r["lerobot"] for r in found)
    return figures


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--root", type=Path, help="dataset to read; none: one is made")
    options.add_argument("--episodes", type=int, default=100, help="of the dataset that is made")
    options.add_argument("--length", type=int, default=32, help="rows of a window")
    options.add_argument("--window", type=int, default=128, help="episodes in memory")
    options.add_argument("--reuse", type=float, default=1.0, help="uses of each row while there")
    args = options.parse_args()
    torch.set_num_threads(1)
    shuffle = ShuffleConfig(args.window, args.reuse)
    with tempfile.TemporaryDirectory() as folder:
        root = args.root or Path(folder) / "dataset"
        if args.root is None:
            write(root, [make_episode(i, 150) for i in range(args.episodes)])
        publish(compare(root, args.length, args.rounds, shuffle), args.json)


if __name__ == "__main__":
    main()
