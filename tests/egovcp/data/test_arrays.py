from pathlib import Path

import numpy as np
import pytest

from egovcp import spec
from egovcp.data import DatasetReader, Episode, load_arrays, open_dataset
from egovcp.errors import DataError


def test_a_dataset_in_one_line(dataset_root: Path, episodes: list[Episode]) -> None:
    data = load_arrays(dataset_root)
    longest = max(map(len, episodes))
    assert data[spec.ACTION_KEY].shape == (len(episodes), longest, spec.ACTION_DIM)
    assert data[spec.DEPTH_KEY].shape == (len(episodes), longest, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    assert data[spec.REWARD_KEY].shape == (len(episodes), longest)
    for i, episode in enumerate(episodes):
        valid = data["valid"][i]
        assert valid.sum() == len(episode)
        np.testing.assert_array_equal(data[spec.DEPTH_KEY][i, valid], episode.depth)
        np.testing.assert_array_equal(data[spec.STATE_KEY][i, valid], episode.state)
        assert not data[spec.STATE_KEY][i, ~valid].any()


def test_some_columns_only(reader: DatasetReader) -> None:
    data = load_arrays(reader, ["action", "next.done"])
    assert set(data) == {"action", "next.done", "valid"}
    assert data["next.done"].dtype == np.bool_


def test_episode_by_episode(dataset_root: Path, episodes: list[Episode]) -> None:
    digests = [episode.digest() for episode in open_dataset(str(dataset_root))]
    assert digests == [episode.digest() for episode in episodes]


def test_what_is_not_there(dataset_root: Path) -> None:
    with pytest.raises(DataError, match="did you mean 'action'"):
        load_arrays(dataset_root, ["actions"])
    with pytest.raises(DataError, match=r"no such folder: .*nowhere/at/all"):
        open_dataset("nowhere/at/all")
