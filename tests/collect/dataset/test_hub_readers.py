"""LeRobot, `datasets` and egovcp read a pushed dataset and return the same frames.

They run in a subprocess because HF_ENDPOINT is read at import.
"""

import json
import os
import subprocess
import sys

import pytest

from egovcp.data import DatasetWriter, Provenance
from egovcp.testing import random_episode
from egovcp_collect.dataset.cli import main
from tests.support.hub import FakeHub, environment, in_this_process

_SCRIPT = """
import json, sys
import numpy as np
from datasets import load_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
from egovcp.data import DatasetConfig, DatasetReader

commit, = sys.argv[1:]
depth, state = "observation.images.ego_depth", "observation.state"

def row(frame):
    return [int(frame["index"]), float(frame[state].sum()), float(frame[depth].sum())]

def lerobot():
    found = LeRobotDataset("me/six")
    return [row(found[i]) for i in range(len(found))]

def lerobot_stream():
    return [row(frame) for frame in StreamingLeRobotDataset("me/six", shuffle=False)]

def datasets_stream():
    files = f"hf://datasets/me/six@{commit}/data/*/*.parquet"
    rows = load_dataset("parquet", data_files=files, split="train", streaming=True)
    return [
        [r["index"], float(np.float32(r[state]).sum()), float(np.asarray(r[depth]).sum())]
        for r in rows
    ]

def egovcp():
    reader = DatasetReader.open(DatasetConfig(repo_id="me/six", revision=commit))
    assert reader.source.commit == commit
    columns = reader.read_columns(["index", state, depth])
    return [[int(i), float(s.sum()), float(d.sum())] for i, s, d in zip(*columns.values())]

print(json.dumps({f.__name__: f() for f in (lerobot, lerobot_stream, datasets_stream, egovcp)}))
"""


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[list[float]]]:
    """Reader -> its rows (index, sum of the state, sum of the depth in mm)."""
    folder = tmp_path_factory.mktemp("readers")
    with DatasetWriter(folder / "six", Provenance("stance-1"), shard_episodes=2) as writer:
        for number in range(3):
            writer.add(random_episode(number))
    with FakeHub(folder / "hub") as hub:
        variables = {**os.environ, **environment(hub.endpoint, folder / "home")}
        with in_this_process(hub.endpoint, folder / "home"):
            assert main(["push", str(folder / "six"), "--repo_id=me/six"]) == 0
        commit = hub.store.refs("datasets/me/six").tags["v3.0"]
        found = subprocess.run(
            [sys.executable, "-c", _SCRIPT, commit],
            env=variables,
            check=True,
            timeout=280,
            stdout=subprocess.PIPE,
        )
    rows: dict[str, list[list[float]]] = json.loads(found.stdout.splitlines()[-1])
    return rows


@pytest.mark.parametrize("reader", ["lerobot", "lerobot_stream", "datasets_stream", "egovcp"])
def test_every_reader_returns_every_frame(seen: dict[str, list[list[float]]], reader: str) -> None:
    episodes = [random_episode(number) for number in range(3)]
    expected = [
        (e.state[t].sum(dtype=float), e.depth[t].sum(dtype=float))
        for e in episodes
        for t in range(len(e))
    ]
    rows = sorted(seen[reader])  # a stream of LeRobot's is shuffled in part
    assert [row[0] for row in rows] == list(range(len(expected)))
    for row, (state, depth) in zip(rows, expected, strict=True):
        assert row[1] == pytest.approx(state, abs=1e-3)
        assert row[2] == pytest.approx(depth, rel=1e-6)
