"""What LeRobot, `datasets` and LeRobot's own viewer make of our files."""

import subprocess
import sys
from pathlib import Path

import datasets
import numpy as np
import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from egovcp import spec
from egovcp.data import Episode
from egovcp.robot_spec import G1


@pytest.fixture(scope="module")
def loaded(dataset_root: Path) -> LeRobotDataset:
    return LeRobotDataset("me/six", root=dataset_root)


def test_lerobot_reads_every_frame(loaded: LeRobotDataset, episodes: list[Episode]) -> None:
    assert loaded.num_episodes == len(episodes)
    assert loaded.meta.depth_keys == [spec.DEPTH_KEY]
    row = 0
    for index, episode in enumerate(episodes):
        for t in range(len(episode)):
            frame = loaded[row]
            np.testing.assert_array_equal(frame[spec.DEPTH_KEY][0], episode.depth[t])
            np.testing.assert_array_equal(frame[spec.STATE_KEY], episode.state[t])
            np.testing.assert_array_equal(frame[spec.ACTION_KEY], episode.action[t])
            assert frame[spec.REWARD_KEY] == episode.reward[t]
            assert frame[spec.DONE_KEY] == episode.done[t]
            assert frame["task"] == episode.task
            assert frame["episode_index"] == index
            assert frame["timestamp"] == pytest.approx(t / spec.PLANNER_HZ)
            row += 1


def test_lerobot_makes_the_same_features(loaded: LeRobotDataset, tmp_path: Path) -> None:
    features = {key: dict(value) for key, value in spec.FEATURES.items()}
    theirs = LeRobotDatasetMetadata.create(
        "me/reference", spec.PLANNER_HZ, features, G1.robot_type, tmp_path / "reference",
        use_videos=False,
    ).info.to_dict()  # fmt: skip
    ours = loaded.meta.info.to_dict()
    for info in (theirs, ours):
        for counted in ("total_episodes", "total_frames", "total_tasks", "splits"):
            info.pop(counted)
        for feature in info["features"].values():
            feature.pop("info", None)
    assert ours == theirs


def test_lerobot_reads_the_statistics(loaded: LeRobotDataset, episodes: list[Episode]) -> None:
    state = np.concatenate([e.state for e in episodes])
    found = loaded.meta.stats[spec.STATE_KEY]
    np.testing.assert_allclose(found["mean"], state.mean(0), atol=1e-5)
    assert loaded.meta.stats[spec.DEPTH_KEY]["mean"].shape == (1, 1, 1)


def test_lerobot_can_delete_and_merge(
    loaded: LeRobotDataset, tmp_path: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets

    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    kept = delete_episodes(loaded, [1, 3], output_dir=tmp_path / "kept", repo_id="me/kept")
    merged = merge_datasets([loaded, kept], "me/merged", tmp_path / "merged")
    assert merged.num_episodes == 2 * len(episodes) - 2
    np.testing.assert_array_equal(merged[-1][spec.DEPTH_KEY][0], episodes[-1].depth[-1])
    action = merged.meta.features[spec.ACTION_KEY]
    assert action["info"]["controller_id"] == "stance-1"


def test_the_hub_library_reads_the_parquet_files(
    dataset_root: Path, tmp_path: Path, episodes: list[Episode]
) -> None:
    rows = datasets.load_dataset(
        "parquet", data_files=str(dataset_root / "data/*/*.parquet"), split="train",
        cache_dir=str(tmp_path),
    )  # fmt: skip
    assert isinstance(rows.features[spec.DEPTH_KEY], datasets.Image)
    assert rows.features[spec.STATE_KEY].length == spec.STATE_DIM
    np.testing.assert_array_equal(np.asarray(rows[0][spec.DEPTH_KEY]), episodes[0].depth[0])


def test_the_viewer_records_an_episode(dataset_root: Path, tmp_path: Path) -> None:
    viewer = Path(sys.executable).with_name("lerobot-dataset-viz")
    subprocess.run(
        [viewer, "--repo-id", "me/six", "--root", dataset_root, "--episode-index", "0",
         "--save", "1", "--output-dir", tmp_path, "--num-workers", "0"],
        check=True, capture_output=True, timeout=240,
    )  # fmt: skip
    (recording,) = tmp_path.glob("*.rrd")
    content = recording.read_bytes()
    assert b"DepthImage" in content
    assert spec.DEPTH_KEY.encode() in content
