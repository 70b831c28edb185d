"""Whether the bounded stream's rate and memory change with the number of episodes.

Datasets of any size from one shard of 100 episodes: every data file is a hard link to the same one,
the `meta` folder is real. Each is streamed in a process of its own.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from writer import make_episode
from writer import writer as write

from egovcp.data import EpisodeIndex, SamplerConfig, ShuffleConfig, StreamingSampler, open_dataset
from egovcp.data.schema import COLLECTION_PATH, EPISODES_PATH, INFO_PATH, SHARD_EPISODES


def multiplied(shard: Path, root: Path, episodes: int) -> Path:
    """A dataset of so many episodes, a multiple of 100, each with an identity of its own."""
    copies = episodes // SHARD_EPISODES
    (data,) = (shard / "data").rglob("*.parquet")
    table = pq.read_table(shard / EPISODES_PATH.format(chunk_index=0, file_index=0))
    info = json.loads((shard / INFO_PATH).read_text(encoding="utf-8"))
    frames = int(info["total_frames"])
    for k in range(copies):
        place = {"chunk_index": k // 1000, "file_index": k % 1000}
        link = root / str(info["data_path"]).format(**place)
        link.parent.mkdir(parents=True, exist_ok=True)
        os.link(data, link)
        path = root / EPISODES_PATH.format(**place)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(_moved(table, k, frames, place), path)
    info |= {"total_episodes": episodes, "total_frames": frames * copies}
    (root / INFO_PATH).write_text(json.dumps(info), encoding="utf-8")
    _copy_facts(shard, root, copies)
    return root


def _moved(table: pa.Table, copy: int, frames: int, place: dict[str, int]) -> pa.Table:
    """The rows of a shard as those of its ``copy``-th repetition."""
    shifts = {
        "episode_index": copy * table.num_rows,
        "dataset_from_index": copy * frames,
        "dataset_to_index": copy * frames,
        "data/chunk_index": place["chunk_index"],
        "data/file_index": place["file_index"],
    }
    for name, shift in shifts.items():
        values = table[name].to_numpy() + shift
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    return table


def _copy_facts(shard: Path, root: Path, copies: int) -> None:
    tasks = "meta/tasks.parquet"
    os.link(shard / tasks, root / tasks)
    facts = json.loads((shard / COLLECTION_PATH).read_text(encoding="utf-8"))
    records = facts["episodes"]
    facts["episodes"] = [
        {**record, "metadata": {**record["metadata"], "episode": k * len(records) + i}}
        for k in range(copies)
        for i, record in enumerate(records)
    ]
    (root / COLLECTION_PATH).write_text(json.dumps(facts), encoding="utf-8")


def streamed(
    root: Path, config: SamplerConfig, shuffle: ShuffleConfig, seconds: float
) -> list[float]:
    """Windows per second of processor time, and resident MB at the most."""
    stream = StreamingSampler(
        EpisodeIndex.of([open_dataset(root)], "train"), config, shuffle=shuffle
    )
    rates = []
    for _ in range(5):
        count, start = 0, time.process_time()
        while (passed := time.process_time() - start) < seconds / 5:
            next(stream)
            count += config.batch_size
        rates.append(count / passed)
    return [float(np.median(rates)), _peak_mb()]


def _peak_mb() -> float:
    """Resident MB at the most, of this program; `getrusage` would count whoever started it."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return float(status.split("VmHWM:")[1].split()[0]) / 1e3


def growth(
    folder: Path, sizes: list[int], config: SamplerConfig, shuffle: ShuffleConfig, seconds: float
) -> dict[str, object]:
    """Rate and memory at each size, and those of the largest by those of the smallest."""
    shard = folder / "shard"
    write(shard, [make_episode(i, 150) for i in range(SHARD_EPISODES)])
    spawn = multiprocessing.get_context("spawn")
    found = {}
    for size in sizes:
        root = multiplied(shard, folder / str(size), size)
        with ProcessPoolExecutor(1, mp_context=spawn) as pool:
            found[size] = pool.submit(streamed, root, config, shuffle, seconds).result()
    figures: dict[str, object] = {}
    for size, (rate, memory) in found.items():
        figures |= {f"episodes_{size}_windows_per_s": rate, f"episodes_{size}_resident_mb": memory}
    few, many = found[min(sizes)], found[max(sizes)]
    return figures | {
        "growth_rate_ratio": many[0] / few[0],
        "growth_memory_ratio": many[1] / few[1],
    }
