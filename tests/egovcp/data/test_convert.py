"""Conversion of LeRobot datasets with other features."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from egovcp.data import DatasetReader, open_dataset
from egovcp.data.convert import convert_dataset
from egovcp.data.source import Source
from egovcp.errors import DataError, UsageError
from tests.support.lerobot_datasets import ACTION, DEPTH, ONE, STATE, VIDEO, write_features

LENGTHS = (7, 9, 8)
DEPTH_VIDEO = {**DEPTH, "dtype": "video", "names": ["height", "width", "channels"]}
FEATURES = {
    "observation.images.top": VIDEO,
    "observation.depth": DEPTH,
    "observation.depth_video": DEPTH_VIDEO,
    "observation.state": STATE,
    "action": ACTION,
    "next.reward": {"dtype": "float32", **ONE},
    "next.success": {"dtype": "bool", **ONE},
    "note": {"dtype": "string", **ONE},
}


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("theirs") / "dataset"
    return write_features(root, FEATURES, LENGTHS, ("pick the cube", "wait"), {"fps": 10})


@pytest.fixture(scope="module")
def frames(theirs: Path) -> list[Mapping[str, Any]]:
    """All frames of `theirs`, as LeRobot reads them."""
    dataset = LeRobotDataset("me/theirs", root=theirs, video_backend="pyav")
    return [dataset[i] for i in range(sum(LENGTHS))]


def _converted(theirs: Path, root: Path, episodes: str = "", **features: str) -> DatasetReader:
    convert_dataset(Source(theirs, "me/theirs", "a" * 40), features, root, episodes)
    return open_dataset(root)


@pytest.fixture
def without_videos(tmp_path: Path) -> Path:
    features = {k: v for k, v in FEATURES.items() if v["dtype"] != "video"}
    options = {"fps": 10, "use_videos": False}
    return write_features(tmp_path / "a", features, LENGTHS, ("x",), options)


def test_numbers_are_those_that_lerobot_reads(
    theirs: Path, frames: list[Mapping[str, Any]], tmp_path: Path
) -> None:
    reader = _converted(theirs, tmp_path / "own", image="observation.depth")
    robot = reader.robot
    assert (robot.robot_type, robot.planner_hz, robot.depth) == ("so100", 10, (16, 16))
    assert (robot.state_names, robot.action_names) == (("pan", "lift", "elbow"), ("pan", "grip"))
    actions = np.stack([frame["action"] for frame in frames])
    np.testing.assert_allclose(robot.action_box.low, actions.min(0))
    np.testing.assert_allclose(robot.action_box.high, actions.max(0))
    episodes = list(reader)
    assert [len(e) for e in episodes] == list(LENGTHS)
    assert [e.task for e in episodes] == ["pick the cube", "wait", "pick the cube"]
    assert all(e.truncated[-1] and not e.terminated for e in episodes)
    normalised = np.concatenate([e.action for e in episodes])
    low, high = (np.array(x) for x in (robot.action_box.low, robot.action_box.high))
    np.testing.assert_allclose(low + (normalised + 1) / 2 * (high - low), actions, atol=1e-6)
    for name, key in (("state", "observation.state"), ("reward", "next.reward")):
        found = np.concatenate([getattr(e, name) for e in episodes])
        np.testing.assert_array_equal(
            found, np.stack([f[key] for f in frames]).reshape(found.shape)
        )
    success = np.concatenate([e.success for e in episodes])
    assert success.tolist() == [bool(f["next.success"]) for f in frames]
    source = reader.provenance["config"]["converted_from"]
    assert (source["repo_id"], source["revision"]) == ("me/theirs", "a" * 40)
    assert reader.origin.origin == "converted"


@pytest.mark.parametrize("name", ["observation.depth", "observation.depth_video"])
def test_depth_is_in_millimetres(
    name: str, theirs: Path, frames: list[Mapping[str, Any]], tmp_path: Path
) -> None:
    reader = _converted(theirs, tmp_path / "own", image=name)
    depth = np.concatenate([e.depth for e in reader])
    assert reader.robot.depth_max_m == 5.0
    for frame, image in zip(frames, depth, strict=True):
        rows = ((np.arange(16) + 0.5) * 24 / 16).astype(int)
        sampled = np.asarray(frame[name]).reshape(24, 32)[rows][:, 1::2]
        np.testing.assert_allclose(image, sampled, atol=1.0)


def test_an_image_of_16_bits_need_not_be_marked_as_depth(theirs: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(theirs, tmp_path / "theirs"))
    info = json.loads((root / "meta/info.json").read_text())
    del info["features"]["observation.depth"]["info"]
    (root / "meta/info.json").write_text(json.dumps(info))
    reader = _converted(root, tmp_path / "own", image="observation.depth")
    marked = _converted(theirs, tmp_path / "marked", image="observation.depth")
    depth, whole = (np.concatenate([e.depth for e in r]) for r in (reader, marked))
    assert reader.robot.depth_max_m == 2.56
    np.testing.assert_array_equal(depth, np.where(whole > 2560, 0, whole))


def test_a_colour_video_becomes_grey(
    theirs: Path, frames: list[Mapping[str, Any]], tmp_path: Path
) -> None:
    reader = _converted(theirs, tmp_path / "own", image="observation.images.top")
    depth = np.concatenate([e.depth for e in reader])
    assert depth.shape == (sum(LENGTHS), 48, 64)
    for frame, image in zip(frames, depth, strict=True):
        red, green, blue = 255 * np.asarray(frame["observation.images.top"])
        grey = 0.299 * red + 0.587 * green + 0.114 * blue
        np.testing.assert_allclose(image / 10 - 1, grey, atol=2.0)


def test_selected_episodes(theirs: Path, tmp_path: Path) -> None:
    reader = _converted(theirs, tmp_path / "own", "[0, 2]", image="observation.depth")
    assert reader.lengths.tolist() == [7, 8]
    assert [reader.metadata(i)["episode"] for i in range(2)] == [0, 2]


@pytest.mark.parametrize(
    ("features", "problem"),
    [
        ({}, "has 3 cameras; give the image as --features='{image: NAME}'; choose from: obs"),
        ({"image": "observation.images.tpo"}, "did you mean 'observation.images.top'?"),
        ({"image": "observation.state"}, "image must be a camera"),
        ({"image": "observation.depth", "state": "note"}, "state must be numbers"),
        ({"image": "observation.depth", "reward": "action"}, "reward must be one value"),
        ({"image": "observation.depth", "success": "next.done"}, "has no feature 'next.done'"),
        ({"pixels": "observation.depth"}, "unknown name 'pixels'; choose from: action, image"),
        ({"image": "observation.depth", "state": "next.reward"}, "state_names are 1 names"),
    ],
)
def test_unsuitable_features(
    features: dict[str, str], problem: str, theirs: Path, tmp_path: Path
) -> None:
    with pytest.raises(UsageError) as caught:
        _converted(theirs, tmp_path / "own", **features)
    assert problem in str(caught.value)
    assert not (tmp_path / "own").exists()


def test_a_dataset_without_rewards(tmp_path: Path) -> None:
    features = {k: FEATURES[k] for k in ("observation.depth", "observation.state", "action")}
    root = write_features(tmp_path / "a", features, (5,), ("x",), {"fps": 10, "use_videos": False})
    with pytest.raises(UsageError, match=r"has no feature 'next.reward'; give the reward"):
        _converted(root, tmp_path / "own")


def test_own_datasets_are_not_converted(theirs: Path, tmp_path: Path) -> None:
    own = _converted(theirs, tmp_path / "own", image="observation.depth")
    with pytest.raises(UsageError, match="has egovcp's features already"):
        _converted(own.root, tmp_path / "again", image="observation.depth")


def test_damage_is_named_and_nothing_is_left(without_videos: Path, tmp_path: Path) -> None:
    path = next((without_videos / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    states = table["observation.state"].to_pylist()
    states[9] = [0.0, float("nan"), 0.0]
    column = table.schema.get_field_index("observation.state")
    field = table.schema.field(column)
    changed = table.set_column(column, field, pa.array(states, field.type))
    pq.write_table(changed, path)
    with pytest.raises(DataError, match=r"episode 1, frame 2: observation.state\[1\].* is nan"):
        _converted(without_videos, tmp_path / "own")
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("key", ["next.reward", "timestamp", "task_index"])
def test_a_missing_column_is_named(key: str, without_videos: Path, tmp_path: Path) -> None:
    root = without_videos
    path = next((root / "data").rglob("*.parquet"))
    pq.write_table(pq.read_table(path).drop_columns([key]), path)
    with pytest.raises(DataError, match=f"parquet, episode 0: column {key} is missing"):
        _converted(root, tmp_path / "own")
    info = json.loads((root / "meta/info.json").read_text())
    del info["features"][key]
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises((DataError, UsageError), match=f"feature '?{key}"):
        _converted(root, tmp_path / "own")
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("damage", ["damaged", "short"])
def test_damage_of_a_video_names_the_video(damage: str, theirs: Path, tmp_path: Path) -> None:
    root, key = Path(shutil.copytree(theirs, tmp_path / "theirs")), "observation.images.top"
    (path,) = (root / "videos" / key).rglob("*.mp4")
    if damage == "damaged":
        path.write_bytes(b"no video")
    else:
        with av.open(str(path), "w") as target:
            stream = target.add_stream("mpeg4", rate=10)
            stream.width, stream.height = 64, 48
            image = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8))
            for packet in (*stream.encode(image), *stream.encode()):
                target.mux(packet)
    with pytest.raises(DataError, match=r"mp4, episode 0.*: (the video is|.* ends after 1 of 7)"):
        _converted(root, tmp_path / "own", image=key)
