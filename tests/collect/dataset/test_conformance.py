"""LeRobot's own tools work on our datasets, and `repair` completes their results."""

from collections.abc import Callable
from pathlib import Path

import datasets
import numpy as np
import pytest
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader
from egovcp_collect.dataset.cli import main

from .conftest import write

#: Makes a dataset out of two, in a new folder: the folder, and the walks that it must hold.
type Tool = Callable[[LeRobotDataset, LeRobotDataset, Path], tuple[Path, list[int]]]


def _delete(six: LeRobotDataset, two: LeRobotDataset, folder: Path) -> tuple[Path, list[int]]:
    delete_episodes(six, [0, 4], output_dir=folder / "kept", repo_id="me/kept")
    return folder / "kept", [1, 2, 3, 5]


def _split(six: LeRobotDataset, two: LeRobotDataset, folder: Path) -> tuple[Path, list[int]]:
    split_dataset(six, {"train": [0, 1, 2, 5], "val": [3, 4]}, output_dir=folder)
    (train,) = folder.glob("*train*")
    return train, [0, 1, 2, 5]


def _merge(six: LeRobotDataset, two: LeRobotDataset, folder: Path) -> tuple[Path, list[int]]:
    merge_datasets([six, two], "me/merged", folder / "merged")
    return folder / "merged", [0, 1, 2, 3, 4, 5, 6, 7]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("more") / "two", [6, 7])


@pytest.mark.parametrize(
    "tool", [*(pytest.param(t, marks=pytest.mark.slow) for t in (_delete, _split)), _merge]
)
def test_results_of_lerobots_tools_load_and_can_be_repaired(
    tool: Tool, sound: Path, two: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    sources = [LeRobotDataset("me/six", root=sound), LeRobotDataset("me/two", root=two)]
    made, walks = tool(*sources, tmp_path / "made")
    originals = [DatasetReader.open(DatasetConfig(root=str(root))) for root in (sound, two)]
    expected = [originals[n // 6].read(n % 6) for n in walks]

    loaded = LeRobotDataset("me/made", root=made)
    assert len(loaded) == sum(map(len, expected))
    row = 0
    for episode in expected:
        for t in (0, len(episode) - 1):
            frame = loaded[row + t]
            np.testing.assert_array_equal(frame[spec.DEPTH_KEY][0], episode.depth[t])
            np.testing.assert_array_equal(frame[spec.STATE_KEY], episode.state[t])
            np.testing.assert_array_equal(frame[spec.ACTION_KEY], episode.action[t])
            assert frame["task"] == episode.task
        row += len(episode)

    assert main(["check", str(made)]) == 3
    assert "egovcp-dataset repair" in capsys.readouterr().err
    whole = tmp_path / "whole"
    assert main(["repair", str(made), f"--records={sound},{two}", f"--output_dir={whole}"]) == 0
    assert main(["check", str(whole)]) == 0
    reader = DatasetReader.open(DatasetConfig(root=str(whole)))
    assert [reader.metadata(i)["episode"] for i in range(len(reader))] == walks
    assert [reader.read(i).digest() for i in range(len(reader))] == [e.digest() for e in expected]
    assert reader.provenance["seed"] == 5
    assert LeRobotDataset("me/whole", root=whole).num_episodes == len(walks)


def test_the_statistics_that_lerobots_tools_write_pass_the_check(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    made, _ = _delete(LeRobotDataset("me/six", root=sound), None, tmp_path)
    whole = tmp_path / "whole"
    assert main(["repair", str(made), f"--records={sound}", f"--output_dir={whole}"]) == 0
    (made / "meta/collection.json").write_bytes((whole / "meta/collection.json").read_bytes())
    assert main(["check", str(made)]) == 0


def test_datasets_reads_the_folder(sound: Path, tmp_path: Path) -> None:
    rows = datasets.load_dataset(
        "parquet", data_dir=str(sound / "data"), split="train", cache_dir=str(tmp_path)
    )
    reader = DatasetReader.open(DatasetConfig(root=str(sound)))
    assert rows["index"] == [*range(reader.num_frames)]
    last = reader.read(len(reader) - 1)
    np.testing.assert_array_equal(np.asarray(rows[-1][spec.DEPTH_KEY]), last.depth[-1])
    np.testing.assert_array_equal(rows[-1][spec.STATE_KEY], last.state[-1])
