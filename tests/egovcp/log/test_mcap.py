"""An MCAP recording reads back as it was written, whole or torn."""

from __future__ import annotations

import json
import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.log.mcap import McapSink
from egovcp.log.mcap_reader import read_recording
from egovcp.log.messages import Topic, motor_readings
from egovcp.log.tick import CameraView, RunInfo, Tick
from egovcp.robot.geometry import pixel_rays
from egovcp.robot.kinematics import LINK_NAMES

ROOT = Path(__file__).parents[3]
INFO = RunInfo(
    task="ball",
    seed=3,
    episode=7,
    camera=CameraView(pitch=0.05),
    config={"planner": {"samples": 64}},
    hashes={"model.safetensors": "00ff"},
    versions={"egovcp": "0.1.0"},
)


def record(path: Path, ticks: list[Tick]) -> Path:
    sink = McapSink(path)
    sink.open(INFO)
    for tick in ticks:
        sink.write(tick)
    sink.close()
    return path


def assert_same(a: Any, b: Any, where: str = "tick") -> None:
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, (left, right) in enumerate(zip(a, b, strict=True)):
            assert_same(left, right, f"{where}[{i}]")
    elif isinstance(a, np.ndarray):
        assert a.shape == b.shape, where
        np.testing.assert_array_equal(a, b, err_msg=where)
    else:
        assert a == b, where


def test_write_then_read_is_the_identity(tmp_path: Path, make_tick: Any) -> None:
    ticks = [make_tick(0, bare=True), make_tick(1), make_tick(2), make_tick(3, bare=True)]
    recording = read_recording(record(tmp_path / "a.mcap", ticks))
    assert recording.complete
    assert_same(recording.info, INFO, "info")
    assert len(recording.ticks) == len(ticks)
    for written, read in zip(ticks, recording.ticks, strict=True):
        assert_same(written, read)


def test_names_of_objects_may_hold_separators(tmp_path: Path, make_tick: Any) -> None:
    tick = make_tick(0)
    names = ("arm:link, left", "50 % of %2C")
    scene = [replace(o, name=name) for o, name in zip(tick.scene, names, strict=True)]
    path = record(tmp_path / "a.mcap", [replace(tick, scene=tuple(scene))])
    assert tuple(o.name for o in read_recording(path).ticks[0].scene) == names


def test_the_row_of_lost_packets_in_older_recordings_is_ignored() -> None:
    dims = [SimpleNamespace(label="faults,lost,enabled", size=3), SimpleNamespace(label="", size=2)]
    status = SimpleNamespace(layout=SimpleNamespace(dim=dims), data=[8.0, 0.0, 5.0, 6.0, 1.0, 0.0])
    joints = SimpleNamespace(effort=[1.0, 2.0])
    found = motor_readings({Topic.JOINTS: joints, Topic.MOTOR_STATUS: status})
    assert found is not None
    assert found.faults is not None
    assert found.enabled is not None
    assert (found.faults.tolist(), found.enabled.tolist()) == ([8, 0], [True, False])


def test_files_may_number_their_topics_differently(tmp_path: Path, make_tick: Any) -> None:
    bare, full = [make_tick(0, bare=True)], [make_tick(0)]
    for name, ticks in (("a", bare), ("b", full), ("c", bare)):
        (read,) = read_recording(record(tmp_path / f"{name}.mcap", ticks)).ticks
        assert_same(ticks[0], read)


def test_the_metadata_record_comes_before_any_tick(tmp_path: Path, make_tick: Any) -> None:
    path = record(tmp_path / "a.mcap", [make_tick(0)])
    with path.open("rb") as file:
        kinds = [type(r).__name__ for r in StreamReader(file).records]
    assert kinds[:2] == ["Header", "Metadata"]
    assert "Chunk" not in kinds
    assert kinds.index("Message") > 1


def test_one_message_per_topic_and_tick_at_the_ticks_time(tmp_path: Path, make_tick: Any) -> None:
    path = record(tmp_path / "a.mcap", [make_tick(i) for i in range(3)])
    with path.open("rb") as file:
        messages = [(c.topic, m.log_time) for _, c, m in make_reader(file).iter_messages()]
    assert len(set(messages)) == len(messages)
    assert {t for _, t in messages} == {0, 40_000_000, 80_000_000}
    for topic in Topic:
        expected = 1 if topic is Topic.LOG else 3
        assert sum(name == topic for name, _ in messages) == expected, topic


def test_a_standard_ros_decoder_reads_every_message(tmp_path: Path, make_tick: Any) -> None:
    tick = make_tick(1)
    path = record(tmp_path / "a.mcap", [tick])
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = {c.topic: d for _, c, _, d in reader.iter_decoded_messages()}
    assert set(decoded) == set(Topic)
    image = decoded[Topic.DEPTH]
    assert (image.encoding, image.height, image.width, image.step) == ("16UC1", 48, 64, 128)
    assert image.header.stamp.nanosec == 40_000_000
    frames = [t.child_frame_id for t in decoded[Topic.TF].transforms]
    assert set(LINK_NAMES) < set(frames)
    assert {t.header.frame_id for t in decoded[Topic.TF].transforms} == {"world"}
    pelvis = decoded[Topic.TF].transforms[frames.index("pelvis")].transform
    assert pelvis.translation.z == pytest.approx(0.7)
    camera = decoded[Topic.CAMERA_INFO]
    assert 2 * np.arctan(24 / camera.k[4]) == pytest.approx(INFO.camera.vertical_fov)
    forward, left, up = pixel_rays(INFO.camera.focal_px).T
    row, column = np.mgrid[:48, :64]
    for matrix in (np.reshape(camera.k, (3, 3)), np.reshape(camera.p, (3, 4))[:, :3]):
        pixels = matrix @ np.stack([-left, -up, forward])  # right, down and forward
        np.testing.assert_allclose(pixels[:2], (column.ravel(), row.ravel()), atol=1e-9)
    assert decoded[Topic.LOG].msg == "ball thrown\nsecond line"
    assert [f.name for f in decoded[Topic.CANDIDATES].fields] == ["x", "y", "z", "value"]


#: What Foxglove and Rerun decode without plugins; Rerun takes poses from the transforms.
DISPLAYED = {
    *("sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"),
    *("sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage", "std_msgs/msg/Float64MultiArray"),
    *("geometry_msgs/msg/PoseStamped", "rcl_interfaces/msg/Log"),
}


def test_every_schema_is_known_to_viewers(tmp_path: Path, make_tick: Any) -> None:
    path = record(tmp_path / "a.mcap", [make_tick(1)])
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} == set(Topic)
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {schema.name for schema in summary.schemas.values()} == DISPLAYED


def _panels(node: Any, by_id: dict[str, Any]) -> list[str]:
    """Names of the panels below a node of the layout, those within tabs included."""
    if isinstance(node, str):
        tabs = by_id[node].get("tabs", ())
        return [node] + [name for tab in tabs for name in _panels(tab["layout"], by_id)]
    return _panels(node["first"], by_id) + _panels(node["second"], by_id)


def test_the_foxglove_layout_names_existing_topics() -> None:
    layout = json.loads((ROOT / "docs" / "foxglove_layout.json").read_text())
    panels = layout["configById"]
    assert sorted(_panels(layout["layout"], panels)) == sorted(panels)
    assert [tab["title"] for tab in panels["Tab!views"]["tabs"]] == ["plan", "robot"]
    named = set(re.findall(r'"(/[a-z_/]+)', json.dumps(panels)))
    assert named <= set(Topic)
    assert panels["3D!robot"]["followTf"] in LINK_NAMES


def test_a_killed_process_loses_no_written_tick(tmp_path: Path, make_tick: Any) -> None:
    sink = McapSink(tmp_path / "a.mcap")
    sink.open(INFO)
    ticks = [make_tick(i) for i in range(4)]
    for tick in ticks:
        sink.write(tick)
    recording = read_recording(tmp_path / "a.mcap")  # not closed: as after kill -9
    sink.close()
    assert not recording.complete
    assert [t.index for t in recording.ticks] == [0, 1, 2, 3]
    assert_same(ticks[3], recording.ticks[3])


def test_a_torn_tail_keeps_all_ticks_before_it(tmp_path: Path, make_tick: Any) -> None:
    path = record(tmp_path / "a.mcap", [make_tick(i) for i in range(6)])
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    recording = read_recording(path)
    assert not recording.complete
    assert [t.index for t in recording.ticks] == list(range(len(recording.ticks)))
    assert 1 <= len(recording.ticks) < 6


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(EnvironmentFailure, match="exists already"):
        McapSink(path).open(INFO)
    assert path.read_bytes() == b"precious"


@pytest.mark.parametrize("content", [None, b"", b"not an mcap file at all, but longer than magic"])
def test_other_files_are_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.mcap"):
        read_recording(path)


def test_close_may_be_repeated_or_come_before_open(tmp_path: Path, make_tick: Any) -> None:
    McapSink(tmp_path / "unopened.mcap").close()
    sink = McapSink(tmp_path / "a.mcap")
    sink.open(INFO)
    sink.write(make_tick(0))
    sink.close()
    sink.close()
    assert read_recording(tmp_path / "a.mcap").complete
