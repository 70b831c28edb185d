"""The other half of `loader.py --lance_python`: windows per second from stable-worldmodel's reader.

Runs under an interpreter that has stable-worldmodel (0.1.1) and need not have egovcp. Its own
writer makes a Lance table of the frames in a folder of arrays, then its `LanceDataset` gives
windows through a `DataLoader`, whose batches it fetches in one read each (`__getitems__`).

Two tables, since its image columns are 8-bit JPEG:

* ``lance``: depth as a column of 3072 numbers, the same content without loss;
* ``lance_jpeg``: depth as its images, 8 bits, compressed: less content, and what it is made for.

Each line on stdin, a case and seconds, is answered by windows per second of processor time of all
its threads, and per second of wall clock.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_worldmodel.data.formats.lance import LanceDataset, LanceWriter
from torch.utils.data import DataLoader, RandomSampler


def episodes(folder: Path, images: bool) -> Iterator[dict[str, Any]]:
    """What the writer takes, episode by episode."""
    columns = {path.stem: np.load(path, mmap_mode="r") for path in folder.glob("*.npy")}
    ends = columns.pop("length").cumsum()
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        found = {name: np.asarray(column[first:end]) for name, column in columns.items()}
        depth = found.pop("depth")
        if images:
            found["pixels"] = (depth // 20).clip(0, 255).astype(np.uint8)[..., None]
        else:
            found["depth"] = depth.reshape(len(depth), -1).astype(np.float32)
        yield {name: list(column) for name, column in found.items()}


def batches(table: Path, length: int, size: int) -> Iterator[object]:
    """Endless batches of windows at random places."""
    dataset = LanceDataset(path=table, num_steps=length)
    sampler = RandomSampler(dataset, replacement=True, num_samples=10**9)
    return iter(DataLoader(dataset, batch_size=size, sampler=sampler))


def measured(stream: Iterator[object], size: int, seconds: float) -> tuple[float, float]:
    """Windows per second of processor time and of wall clock."""
    count, start, wall = 0, time.process_time(), time.perf_counter()
    while (passed := time.process_time() - start) < seconds:
        next(stream)
        count += size
    return count / passed, count / (time.perf_counter() - wall)


def main() -> None:
    """``lance_windows.py FOLDER LENGTH BATCH``."""
    folder, length, size = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    torch.set_num_threads(1)
    streams = {}
    for name, images in (("lance", False), ("lance_jpeg", True)):
        table = folder / f"{name}.lance"
        with LanceWriter(table, mode="overwrite") as writer:
            writer.write_episodes(episodes(folder, images))
        streams[name] = batches(table, length, size)
        next(streams[name])
    print("ready", *streams, flush=True)
    for line in sys.stdin:
        name, seconds = line.split()
        print(*measured(streams[name], size, float(seconds)), flush=True)


if __name__ == "__main__":
    main()
