"""Training windows per second: other readers against the two streams.

The same dataset and windows of the same length, batch by batch, one process each with one thread:

* ``lerobot``: `LeRobotDataset` with `delta_timestamps` for every feature that a window needs, items
  at random places, collated by torch;
* ``ram``: `egovcp.data.InMemorySampler`, all episodes in memory;
* ``bounded``: `egovcp.data.StreamingSampler`, episodes read from the disk through a shuffle window;
* ``lance``, ``lance_jpeg`` (with --lance_python): stable-worldmodel's reader, see
  `lance_windows.py`; ratios of ours to it are to the faster of its two ways.

The cases take turns; ratios are medians of the ratios of one turn. Processor time counts, so that
other programs on the machine do not. The disk's pages are cached: this measures decoding.

Beside them, by wall clock, an epoch from a Hub on this machine with an empty cache against the same
epoch from the disk (``hub_ratio``), and, with --growth, rate and memory of the bounded stream over
datasets of many more episodes.

    python benchmarks/loader.py --root data/wall
    uv venv outputs/swm
    uv pip install --python outputs/swm/bin/python stable-worldmodel opencv-python-headless imageio
    python benchmarks/loader.py --lance_python outputs/swm/bin/python --growth 100 1000 10000
"""

from __future__ import annotations

import contextlib
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from growth import growth
from hub_stream import epoch_rates
from lance_reader import CASES, LanceReader, lance_reader
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from report import parser, publish
from torch.utils.data import default_collate
from writer import make_episode
from writer import writer as write

from egovcp import spec
from egovcp.data import (
    EpisodeIndex,
    EpisodeStore,
    InMemorySampler,
    SamplerConfig,
    ShuffleConfig,
    StreamingSampler,
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


def compare(
    index: EpisodeIndex,
    length: int,
    rounds: int,
    shuffle: ShuffleConfig,
    lance: LanceReader | None,
) -> dict[str, object]:
    """The rates, and the ratios of ours to the others'."""
    config = SamplerConfig(batch_size=BATCH, length=length)
    (reader,) = index.readers
    cases: dict[str, Callable[[], Iterator[object]]] = {
        "lerobot": lambda: lerobot(reader.root, length),
        "ram": lambda: InMemorySampler(EpisodeStore.read(index), config),
        "bounded": lambda: StreamingSampler(index, config, shuffle=shuffle),
    }
    streams = {name: make() for name, make in cases.items()}
    for stream in streams.values():
        next(stream)
    found = []
    for _ in range(rounds):
        row = {name: measured(stream, 1.0) for name, stream in streams.items()}
        for name in CASES if lance else ():
            assert lance is not None
            row[name], row[f"{name}_wall"] = lance.measure(name, 1.0)
        found.append(row)
    figures: dict[str, object] = {
        "episodes": len(index),
        "frames": index.num_frames,
        "window": length,
        "batch": BATCH,
        "shuffle_episodes": shuffle.episodes,
        "shuffle_reuse": shuffle.reuse,
    }
    figures |= {f"{k}_windows_per_s": statistics.median(r[k] for r in found) for k in found[0]}
    for name in ("ram", "bounded"):
        figures[f"{name}_ratio"] = statistics.median(r[name] / r["lerobot"] for r in found)
        if lance:
            ratios = (r[name] / max(r[case] for case in CASES) for r in found)
            figures[f"{name}_lance_ratio"] = statistics.median(ratios)
    return figures


def from_hub(folder: Path, episodes: int, length: int, rounds: int) -> dict[str, object]:
    """An epoch from the Hub against one from the disk."""
    config, shuffle = SamplerConfig(batch_size=BATCH, length=length), ShuffleConfig(32)
    rows = epoch_rates(folder, episodes, config, shuffle, rounds)
    rates = {
        f"{name}_epoch_windows_per_s": statistics.median(r[name] for r in rows) for name in rows[0]
    }
    return rates | {"hub_ratio": statistics.median(r["hub"] / r["disk"] for r in rows)}


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--root", type=Path, help="dataset to read; none: one is made")
    options.add_argument("--episodes", type=int, default=100, help="of the dataset that is made")
    options.add_argument("--length", type=int, default=32, help="rows of a window")
    options.add_argument("--window", type=int, default=128, help="episodes in memory")
    options.add_argument("--reuse", type=float, default=1.0, help="uses of each row while there")
    options.add_argument("--lance_python", type=Path, help="Python that has stable-worldmodel")
    options.add_argument("--hub_episodes", type=int, default=400, help="streamed; 0: none")
    options.add_argument(
        "--growth", type=int, nargs="*", default=[], help="numbers of episodes, multiples of 100"
    )
    args = options.parse_args()
    torch.set_num_threads(1)
    shuffle = ShuffleConfig(args.window, args.reuse)
    figures: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        home = Path(folder)
        root = args.root or home / "dataset"
        if args.root is None:
            write(root, [make_episode(i, 150) for i in range(args.episodes)])
        index = EpisodeIndex.of([open_dataset(root)], "train")
        if args.hub_episodes:  # first: by the clock, and with files that want memory, alone
            figures |= from_hub(home / "remote", args.hub_episodes, args.length, args.rounds)
        lance = None
        if args.lance_python is None:
            print("stable-worldmodel's reader is left out: no --lance_python")
        else:
            lance = stack.enter_context(
                lance_reader(args.lance_python, index, home / "lance", args.length, BATCH)
            )
        figures |= compare(index, args.length, args.rounds, shuffle, lance)
        if args.growth:
            config = SamplerConfig(batch_size=BATCH, length=args.length)
            figures |= growth(home / "growth", args.growth, config, shuffle, seconds=5.0)
        publish(figures, args.json)


if __name__ == "__main__":
    main()
