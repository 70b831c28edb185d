"""LeRobot, `datasets` and egovcp read a pushed dataset and return the same frames."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from datasets import load_dataset
from lerobot.datasets import dataset_metadata, streaming_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Provenance
from egovcp.testing import random_episode
from egovcp_collect.dataset.cli import main
from tests.support.hub import FakeHub, redirect_hub

#: (index, sum of the state, sum of the depth in mm).
type Row = tuple[int, float, float]


@pytest.fixture(scope="module")
def commit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The commit of ``me/six`` on a fake Hub, to which this process's libraries talk."""
    folder = tmp_path_factory.mktemp("readers")
    with DatasetWriter(folder / "six", Provenance("stance-1"), shard_episodes=2) as writer:
        for number in range(3):
            writer.add(random_episode(number))
    with FakeHub(folder / "hub") as hub, redirect_hub(hub.endpoint, folder / "home"):
        assert main(["push", str(folder / "six"), "--repo_id=me/six"]) == 0
        yield hub.store.refs("datasets/me/six").tags["v3.0"]


def _row(frame: dict[str, np.ndarray]) -> Row:
    return (
        int(frame["index"]),
        float(np.asarray(frame[spec.STATE_KEY], np.float32).sum()),
        float(np.asarray(frame[spec.DEPTH_KEY]).sum()),
    )


def _lerobot(commit: str) -> list[Row]:
    found = LeRobotDataset("me/six")
    return [_row(found[i]) for i in range(len(found))]


def _lerobot_stream(commit: str) -> list[Row]:
    frames = StreamingLeRobotDataset("me/six", shuffle=False)
    return [_row(frame) for frame in frames]


def _datasets_stream(commit: str) -> list[Row]:
    files = f"hf://datasets/me/six@{commit}/data/*/*.parquet"
    return [
        _row(r) for r in load_dataset("parquet", data_files=files, split="train", streaming=True)
    ]


def _egovcp(commit: str) -> list[Row]:
    reader = DatasetReader.open(DatasetConfig(repo_id="me/six", revision=commit))
    assert reader.source.commit == commit
    columns = reader.read_columns(["index", spec.STATE_KEY, spec.DEPTH_KEY])
    return [
        (int(i), float(s.sum()), float(d.sum())) for i, s, d in zip(*columns.values(), strict=True)
    ]


def test_lerobot_looks_for_local_datasets_in_the_redirected_home(commit: str) -> None:
    home = Path(os.environ["HF_LEROBOT_HOME"])
    assert dataset_metadata.HF_LEROBOT_HOME == streaming_dataset.HF_LEROBOT_HOME == home


@pytest.mark.parametrize("read", [_lerobot, _lerobot_stream, _datasets_stream, _egovcp])
def test_every_reader_returns_every_frame(commit: str, read: Callable[[str], list[Row]]) -> None:
    episodes = [random_episode(number) for number in range(3)]
    expected = [
        (e.state[t].sum(dtype=float), e.depth[t].sum(dtype=float))
        for e in episodes
        for t in range(len(e))
    ]
    rows = sorted(read(commit))  # a stream of LeRobot's is shuffled in part
    assert [row[0] for row in rows] == list(range(len(expected)))
    for row, (state, depth) in zip(rows, expected, strict=True):
        assert row[1] == pytest.approx(state, abs=1e-3)
        assert row[2] == pytest.approx(depth, rel=1e-6)
