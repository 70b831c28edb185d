"""Conversion of recordings of other programs, with other topics."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from mcap.writer import Writer
from PIL import Image

from egovcp.errors import DataError
from egovcp.log.ros2 import definition, image_16uc1
from egovcp_collect.dataset.cli import main as dataset_command
from egovcp_deploy.mcap.cli import main
from egovcp_deploy.mcap.topics import TopicMapping, TopicRecording

RATE_HZ, FRAMES = 20, 30
COLOURS = np.random.default_rng(0).integers(0, 255, (FRAMES, 24, 32, 3), np.uint8)
DEPTH = np.random.default_rng(1).integers(300, 5000, (FRAMES, 24, 32)).astype(np.uint16)
FEATURES: dict[str, Any] = {
    "observation.images.front": "/camera/front",
    "observation.images.depth": "/camera/depth",
    "observation.state": ["/joint_states.position", "/gripper.width"],
    "action": "/command.data[0]",
    "next.reward": "/reward",
    "next.done": "/status.done",
}
MAPPING = {"fps": RATE_HZ, "task": "pick", "hold": ["/gripper"], "features": FEATURES}

type Foreign = Callable[..., Path]


def _png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


@pytest.fixture
def foreign(tmp_path: Path) -> Foreign:
    """``foreign(...)`` writes a recording as of ROS 2 and Foxglove; ``skip`` leaves frames out."""

    def write(
        name: str = "bag.mcap",
        skip: range = range(0),
        width: int = 7,
        joint: float = 1.0,
        damage: Callable[[bytes], bytes] = lambda png: png,
    ) -> Path:
        path = tmp_path / name
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            ros = writer.register_schema(
                "sensor_msgs/msg/Image", "ros2msg", definition("sensor_msgs/Image").encode()
            )
            plain = writer.register_schema("any", "jsonschema", b"{}")
            topics = ("/camera/front", "/joint_states", "/gripper", "/command", "/reward")
            channels = {t: writer.register_channel(t, "json", plain) for t in (*topics, "/status")}
            depth = writer.register_channel("/camera/depth", "cdr", ros)

            def add(topic: str, time: int, message: object) -> None:
                writer.add_message(channels[topic], time, json.dumps(message).encode(), time)

            for t in range(FRAMES):
                time = 10**18 + t * 10**9 // RATE_HZ
                if t % 15 == 0:
                    add("/gripper", time, {"width": t / 100})
                if t in skip:
                    continue
                png = base64.b64encode(damage(_png(COLOURS[t]))).decode()
                add("/camera/front", time, {"format": "png", "data": png})
                add("/joint_states", time, {"name": ["a"] * width, "position": [joint * t] * width})
                add("/command", time, {"layout": {}, "data": [t, -t]})
                add("/reward", time, 0.5)
                add("/status", time, {"done": t == FRAMES - 1})
                writer.add_message(depth, time, image_16uc1(time, "camera", DEPTH[t]), time)
            writer.finish()
        return path

    return write


def _convert(tmp_path: Path, files: list[Path], *flags: str, **changes: object) -> int:
    mapping = tmp_path / "mapping.json"
    mapping.write_text(json.dumps(MAPPING | changes))
    names = [str(file) for file in files]
    options = [f"--mapping={mapping}", f"--dataset.root={tmp_path / 'new'}", *flags]
    return main(["to-dataset", *names, *options])


def test_mapped_topics_become_a_dataset(foreign: Foreign, tmp_path: Path) -> None:
    files = [foreign(), foreign("other.mcap", joint=2.0)]
    assert _convert(tmp_path, files, names={"action": ["gripper"]}) == 0
    assert dataset_command(["check", str(tmp_path / "new")]) == 0
    dataset = LeRobotDataset("me/new", root=tmp_path / "new")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 2 * FRAMES, RATE_HZ)
    for t in (0, 14, FRAMES - 1):
        row = dataset[FRAMES + t]
        front = (row["observation.images.front"] * 255).round().byte().permute(1, 2, 0)
        np.testing.assert_array_equal(front, COLOURS[t])
        np.testing.assert_array_equal(row["observation.images.depth"][0], DEPTH[t])
        expected = [2.0 * t] * 7 + [0.15 if t >= 15 else 0.0]
        np.testing.assert_allclose(row["observation.state"], expected)
        assert (float(row["action"]), float(row["next.reward"])) == (t, 0.5)
        assert bool(row["next.done"]) == (t == FRAMES - 1)
        assert row["task"] == "pick"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"features": {"action": "/comand.data"}}, "no topic of '/comand.data'; the file has /cam"),
        ({"features": {"action": "/command.dat"}}, "no field dat; there are layout, data"),
        ({"features": {"action": "/command.data[9]"}}, "action from /command.data[9]: list index"),
        ({"features": {"action": "/joint_states"}}, "'a' is not a number"),
        ({"features": {"action": "/command.layout"}}, "action from /command.layout: no number"),
        ({"hold": []}, "/gripper has 1.33 messages per second, but fps is 20"),
        ({"fps": 50}, "20 messages per second, but fps is 50"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused(
    foreign: Foreign,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, object],
    words: str,
) -> None:
    assert _convert(tmp_path, [foreign()], **changes) == 3
    assert words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag.mcap", "mapping.json"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fsp": 20}, "unknown option fsp"),
        ({"task": ""}, "a task"),
        ({"features": {"timestamp": "/reward"}}, "'timestamp' cannot be the name"),
        ({"features": {"task": "/reward"}}, "'task' cannot be the name"),
        ({"features": {"": "/reward"}}, "'' cannot be the name"),
        ({"features": {"action": []}}, "features.action names no topic"),
        ({"names": {"acton": ["x"]}}, "names has ['acton'], which features has not"),
        ({"names": {"action": ["x", "y"]}}, "names.action has 2 names, but the feature has 1 v"),
        ({"names": {"observation.images.front": ["x"]}}, "1 names, but the feature is an image"),
    ],
)
def test_a_wrong_mapping_is_refused(
    foreign: Foreign,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, object],
    words: str,
) -> None:
    assert _convert(tmp_path, [foreign()], **changes) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_another_shape_is_refused(
    foreign: Foreign, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _convert(tmp_path, [foreign(), foreign("b.mcap", width=6)]) == 3
    error = capsys.readouterr().err
    assert "b.mcap, frame 0: observation.state has shape (7,), before (8,)" in error
    assert not (tmp_path / "new").exists()


def test_a_pause_is_refused_or_cut(
    foreign: Foreign, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = foreign(skip=range(10, 15))
    assert _convert(tmp_path, [file]) == 3
    assert "for 0.30 s before row 12; --gaps=cut keeps" in capsys.readouterr().err
    assert _convert(tmp_path, [file], "--gaps=cut") == 0
    assert dataset_command(["check", str(tmp_path / "new")]) == 0
    assert "12 rows, cut: nothing on" in capsys.readouterr().out


def test_a_damaged_image_is_refused(
    foreign: Foreign, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = foreign(damage=lambda png: png[:37] + b"\0\0\0\0" + png[41:])  # the name of a chunk
    assert _convert(tmp_path, [file]) == 3
    error = capsys.readouterr().err
    assert (
        "bag.mcap, frame 0: observation.images.front from /camera/front: its data is not" in error
    )
    assert not (tmp_path / "new").exists()


def test_a_torn_file_is_refused(
    foreign: Foreign, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = foreign()
    file.write_bytes(file.read_bytes()[:-2000])
    assert _convert(tmp_path, [file]) == 3
    assert "expected a complete MCAP file" in capsys.readouterr().err


def test_a_damaged_file_is_refused_or_gives_the_same_rows(foreign: Foreign, tmp_path: Path) -> None:
    mapping = TopicMapping(RATE_HZ, "pick", FEATURES, hold=["/gripper"])

    def rows(path: Path) -> list[dict[str, bytes]]:
        found = TopicRecording(path, mapping).rows({})
        return [{key: value.tobytes() for key, value in row.items()} for row in found]

    path = foreign()
    whole, expected, refused = path.read_bytes(), rows(path), 0
    places = [*range(20, len(whole), len(whole) // 50), len(whole) - 308, len(whole) - 21]
    for place in places:
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(whole[:place] + bytes([whole[place] ^ 0x91]) + whole[place + 1 :])
        try:
            assert rows(damaged) == expected, place
        except DataError:
            refused += 1
    assert refused > len(places) / 2
