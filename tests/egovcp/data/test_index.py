"""Splits of datasets, selected episodes, and the description of the held-out ones."""

import json
from pathlib import Path

import pytest

from egovcp.data import DatasetReader, EpisodeIndex, describe_heldout
from egovcp.data import index as index_module
from egovcp.data.index import SPLITS, in_split
from egovcp.dataset_options import SelectedDatasetConfig


def test_the_held_out_episodes_are_named(
    reader: DatasetReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_module, "HELDOUT_FRACTION", 0.4)
    index = EpisodeIndex.of([reader, reader], "heldout")
    found = describe_heldout([reader, reader])
    assert found["numbers"] == [index.number[index.dataset == d].tolist() for d in (0, 1)]
    assert found["count"] == len(index) == sum(map(len, found["numbers"]))
    assert found["fingerprint"] == index.fingerprint
    assert json.loads(json.dumps(found)) == found

    monkeypatch.setattr(index_module, "MAX_LISTED", found["count"] - 1)
    assert describe_heldout([reader, reader]) == found | {"numbers": None}


def test_only_selected_episodes_are_in_a_split(
    dataset_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_module, "HELDOUT_FRACTION", 0.4)
    everything = EpisodeIndex.of(
        [DatasetReader.open(SelectedDatasetConfig(root=str(dataset_root)))]
    )
    config = SelectedDatasetConfig(root=str(dataset_root), episodes="[1:3, 5]")
    reader = DatasetReader.open(config)
    assert EpisodeIndex.of([reader]).number.tolist() == [1, 2, 5]
    parts = [EpisodeIndex.of([reader], split) for split in ("train", "heldout")]
    assert sorted(n for part in parts for n in part.number.tolist()) == [1, 2, 5]
    assert len(everything) == 6


@pytest.mark.parametrize("split", SPLITS)
def test_no_episode_is_in_a_split_of_none(split: str) -> None:
    assert in_split([], split) == []


@pytest.mark.parametrize("chosen", ["0:6", "0:3", "[1, 4]", "2:"])
def test_no_selection_trains_on_held_out_episodes(
    dataset_root: Path, chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither those whose hash says so, nor the one that stands in for them."""
    monkeypatch.setattr(index_module, "HELDOUT_FRACTION", 0.3)

    def split(text: str, name: str) -> set[str]:
        config = SelectedDatasetConfig(root=str(dataset_root), episodes=text)
        return set(EpisodeIndex.of([DatasetReader.open(config)], name).identities)

    assert not split(chosen, "train") & split("", "heldout")
