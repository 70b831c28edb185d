"""Some episodes of a dataset, by number and by range."""

from pathlib import Path

import numpy as np
import pytest

from egovcp.cli import SelectedDatasetConfig
from egovcp.data import DatasetReader, EpisodeIndex
from egovcp.data.source import select_episodes
from egovcp.errors import UsageError


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("", range(10)),
        ("[3]", [3]),
        ("[5, 0, 7, 5]", [0, 5, 7]),
        ("5,0", [0, 5]),
        ("2:5", [2, 3, 4]),
        (":2", [0, 1]),
        ("8:", [8, 9]),
        ("[0:2, 9, 4:6]", [0, 1, 4, 5, 9]),
        ("(0:2, 9)", [0, 1, 9]),
    ],
)
def test_numbers_and_ranges(text: str, numbers: list[int]) -> None:
    np.testing.assert_array_equal(select_episodes(text, 10), numbers)


@pytest.mark.parametrize("text", ["0:11", "[3, 10]", "20:30", "0:999999999999"])
def test_episodes_out_of_range_are_refused_with_the_count(text: str) -> None:
    with pytest.raises(UsageError, match=r"the dataset has 10 episodes, 0 to 9"):
        select_episodes(text, 10)


@pytest.mark.parametrize("text", ["a", "[1, x]", "-1", "[]", "1:2:3", "1.5", f"[{'9' * 5000}]"])
def test_a_malformed_selection_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"is not an episode; expected numbers, \[0, 5, 7\]"):
        select_episodes(text, 10)


def test_an_empty_range_is_refused() -> None:
    with pytest.raises(UsageError, match="selects no episode; there are 10"):
        select_episodes("5:5", 10)


def test_a_number_that_may_be_a_yaml_range_is_refused() -> None:
    """Unquoted, 1:30 is one minute and a half."""
    with pytest.raises(UsageError, match=r"write \[90\].*quote a range"):
        select_episodes("90", 100)


def test_only_selected_episodes_are_in_a_split(dataset_root: Path) -> None:
    everything = EpisodeIndex.of(
        [DatasetReader.open(SelectedDatasetConfig(root=str(dataset_root)))]
    )
    config = SelectedDatasetConfig(root=str(dataset_root), episodes="[1:3, 5]")
    reader = DatasetReader.open(config)
    assert EpisodeIndex.of([reader]).number.tolist() == [1, 2, 5]
    parts = [EpisodeIndex.of([reader], split, 0.4) for split in ("train", "heldout")]
    assert sorted(n for part in parts for n in part.number.tolist()) == [1, 2, 5]
    assert len(everything) == 6


@pytest.mark.parametrize("chosen", ["0:6", "0:3", "[1, 4]", "2:"])
def test_no_selection_trains_on_held_out_episodes(dataset_root: Path, chosen: str) -> None:
    """Neither those whose hash says so, nor the one that stands in for them."""

    def split(text: str, name: str) -> set[str]:
        config = SelectedDatasetConfig(root=str(dataset_root), episodes=text)
        return set(EpisodeIndex.of([DatasetReader.open(config)], name, 0.3).identities)

    assert not split(chosen, "train") & split("", "heldout")
