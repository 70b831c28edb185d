"""Writing episodes: LeRobot's own writer against `DatasetWriter` and the path of egovcp-collect.

The same frames, from arrays in memory to a complete dataset on the disk:

* ``lerobot``: `LeRobotDataset.add_frame` per frame, `save_episode`, `finalize`;
* ``writer``: `egovcp.data.DatasetWriter`;
* ``collect``: every episode encoded, staged (flushed to the disk) and committed in shards, as
  `egovcp-collect` does.

    python benchmarks/writer.py
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from datasets import disable_progress_bars
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from report import parser, publish

from egovcp import spec
from egovcp.data import DatasetWriter, Episode, Provenance
from egovcp.data.committer import open_committer
from egovcp.data.staging import encode
from egovcp.testing import random_episode

PROVENANCE = Provenance("benchmark")


def make_episode(number: int, ticks: int) -> Episode:
    """Depth as a camera sees it, a ramp with noise and holes, since it is compressed."""
    rng = np.random.default_rng(number)
    pixels = (ticks, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    ramp = np.linspace(4500, 900, spec.DEPTH_ROWS)[:, None]
    depth = (ramp + rng.normal(0, 20, pixels)).clip(280, 5000).astype(np.uint16)
    depth[rng.random(pixels) < 0.3] = 0
    return replace(random_episode(number, ticks), depth=depth)


def lerobot(root: Path, episodes: Sequence[Episode]) -> None:
    """Frame by frame, as in its documentation."""
    dataset = LeRobotDataset.create(
        "me/bench", spec.PLANNER_HZ, spec.FEATURES, root=root, use_videos=False
    )
    for e in episodes:
        for t in range(len(e)):
            dataset.add_frame(
                {
                    spec.DEPTH_KEY: e.depth[t, :, :, None],
                    spec.STATE_KEY: e.state[t],
                    spec.ACTION_KEY: e.action[t],
                    spec.REWARD_KEY: e.reward[t : t + 1],
                    spec.DONE_KEY: e.done[t : t + 1],
                    spec.SUCCESS_KEY: e.success[t : t + 1],
                    spec.TRUNCATED_KEY: e.truncated[t : t + 1],
                    spec.REWARD_TERMS_KEY: e.reward_terms[t],
                    spec.OBJECT_KEY: e.object[t],
                    "task": e.task,
                }
            )
        dataset.save_episode()
    dataset.finalize()


def write_dataset(root: Path, episodes: Sequence[Episode]) -> None:
    """Whole episodes."""
    with DatasetWriter(root, PROVENANCE) as out:
        for episode in episodes:
            out.add(episode)


def collect(root: Path, episodes: Sequence[Episode]) -> None:
    """Staged one by one, committed together."""
    with open_committer(root, PROVENANCE) as committer:
        for number, episode in enumerate(episodes):
            committer.staging.put(number, encode(episode))
            committer.mark_staged(number)
        committer.commit()


def rate(write: Callable[[Path, Sequence[Episode]], None], episodes: Sequence[Episode]) -> float:
    """Frames per second."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        write(Path(folder) / "dataset", episodes)
        return sum(map(len, episodes)) / (time.perf_counter() - start)


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--episodes", type=int, default=12)
    options.add_argument("--ticks", type=int, default=150)
    args = options.parse_args()
    disable_progress_bars()  # one per episode
    episodes = [make_episode(i, args.ticks) for i in range(args.episodes)]
    for write in (lerobot, write_dataset, collect):
        rate(write, episodes[:1])  # imports, first allocations
    found = [
        [rate(w, episodes) for w in (lerobot, write_dataset, collect)] for _ in range(args.rounds)
    ]
    metrics = {}
    for i, name in enumerate(("lerobot", "writer", "collect")):
        metrics[f"{name}_frames_per_s"] = statistics.median(row[i] for row in found)
        if i:
            metrics[f"{name}_ratio"] = statistics.median(row[i] / row[0] for row in found)
    publish(metrics, args.json)


if __name__ == "__main__":
    main()
