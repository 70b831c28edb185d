"""A Rerun recording loads in Rerun itself and holds what the ticks held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.blueprint import Container
from rerun.experimental import RrdReader

from egovcp.errors import EnvironmentFailure
from egovcp.log import paths
from egovcp.log.blueprint import blueprint
from egovcp.log.pose import robot_pose
from egovcp.log.rerun import BATCH_TICKS, RerunSink
from egovcp.log.rerun_columns import chosen_pixel
from egovcp.log.tick import RunInfo, Tick, ValueMap
from egovcp.robot.kinematics import LINK_NAMES
from egovcp.spec import ACTION_BOX

INFO = RunInfo(task="ball", seed=1, episode=2)


@pytest.fixture(autouse=True)
def imagined_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ticks of these tests have five imagined images."""
    monkeypatch.setattr(paths, "IMAGINED_TICKS", (1, 5))


def record(path: Path, ticks: Sequence[Tick], **options: Any) -> Any:
    sink = RerunSink(path, **options)
    sink.open(INFO)
    for tick in ticks:
        sink.write(tick)
    sink.close()
    return RrdReader(path).store()


def column(store: Any, path: str, component: str) -> list[Any]:
    """Values of one component over time, in the order of the ticks."""
    rows: list[tuple[int, Any]] = []
    for chunk in store.stream().to_chunks():
        if chunk.entity_path != path or chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            ticks = batch.column("tick").to_pylist()
            rows += zip(ticks, batch.column(component).to_pylist(), strict=True)
    return [value for _, value in sorted(rows)]


def entities(store: Any) -> set[str]:
    return set(store.schema().entity_paths())


def test_every_field_of_a_tick_is_logged(tmp_path: Path, make_tick: Any) -> None:
    ticks = [make_tick(i) for i in range(3)]
    found = entities(record(tmp_path / "a.rrd", ticks))
    fixed = [paths.DEPTH, paths.RECONSTRUCTED, paths.CAMERA, paths.CANDIDATES, paths.BEST]
    named = [f"{paths.ROBOT}/{link}" for link in LINK_NAMES]
    named += [f"{paths.IMAGINED}/{i}" for i in range(2)] + [f"{paths.SCENE}/ball"]
    named += ["/plan/value", "/plan/termination", "/reward/block", "/timing/plan", "/events"]
    named += ["/motors/temperature/left_leg", "/motors/torque/waist", "/link/state_lost"]
    named += ["/motors/faults/left_ankle_pitch_joint", "/runner/init"]
    assert set(fixed + named) <= found


@pytest.mark.parametrize("count", [1, BATCH_TICKS, BATCH_TICKS + 1])
def test_the_last_partial_batch_is_sent(tmp_path: Path, make_tick: Any, count: int) -> None:
    ticks = [make_tick(i) for i in range(count)]
    store = record(tmp_path / "a.rrd", ticks, meshes=False)
    rewards = column(store, "/reward/total", "Scalars:scalars")
    np.testing.assert_allclose(np.ravel(rewards), [tick.reward for tick in ticks])


def test_depth_is_logged_bit_for_bit(tmp_path: Path, make_tick: Any) -> None:
    ticks = [make_tick(i) for i in range(2)]
    store = record(tmp_path / "a.rrd", ticks, meshes=False)
    for tick, blob in zip(ticks, column(store, paths.DEPTH, "DepthImage:buffer"), strict=True):
        image = np.asarray(blob[0], np.uint8).view(np.uint16).reshape(48, 64)
        np.testing.assert_array_equal(image, tick.depth)


def test_missing_fields_are_left_out(tmp_path: Path, make_tick: Any) -> None:
    found = entities(record(tmp_path / "a.rrd", [make_tick(0, bare=True)], meshes=False))
    assert paths.DEPTH in found
    assert not any(path.startswith((paths.SCENE, paths.PLAN)) for path in found)


def test_without_meshes_the_robot_is_a_skeleton(tmp_path: Path, make_tick: Any) -> None:
    store = record(tmp_path / "a.rrd", [make_tick(0)], meshes=False)
    (strips,) = column(store, paths.SKELETON, "LineStrips3D:strips")
    assert len(strips) == len(LINK_NAMES) - 1 + 2


def test_recordings_of_the_same_episode_have_different_ids(tmp_path: Path, make_tick: Any) -> None:
    recordings = []
    for name in ("a.rrd", "b.rrd"):
        record(tmp_path / name, [make_tick(0, bare=True)], meshes=False)
        recordings += RrdReader(tmp_path / name).recordings()
    assert len({recording.recording_id for recording in recordings}) == 2


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    path.write_bytes(b"precious")
    with pytest.raises(EnvironmentFailure, match="exists already"):
        RerunSink(path, meshes=False).open(INFO)
    assert path.read_bytes() == b"precious"


def test_value_maps_are_images_with_the_best_point_brightest(
    tmp_path: Path, make_tick: Any
) -> None:
    tick = make_tick(1)
    store = record(tmp_path / "a.rrd", [tick], meshes=False)
    for value_map in tick.value_maps:
        (blob,) = column(store, f"{paths.VALUE_MAP}/{value_map.hand}", "Image:buffer")
        image = np.asarray(blob[0], np.uint8).reshape(*value_map.values.shape, 3)
        best = np.unravel_index(value_map.values.argmax(), value_map.values.shape)
        row = len(value_map.z_b) - 1 - best[0]  # high is up
        assert image[row, best[1]].tolist() == [253, 231, 37]


def test_the_dot_marks_the_planned_hand_target(make_tick: Any) -> None:
    grid = np.array([0.1, 0.2, 0.3], np.float32)
    value_map = ValueMap("right", grid, -0.2, grid, np.zeros((3, 3), np.float32))
    target = ACTION_BOX.to_metric(np.zeros(7))
    target[3], target[5] = 0.2, 0.3
    tick = replace(make_tick(0), action_planned=ACTION_BOX.to_normalised(target))
    np.testing.assert_allclose(chosen_pixel(tick, value_map), (1.5, 0.5), atol=1e-5)


def test_candidates_are_world_paths_coloured_by_value(tmp_path: Path, make_tick: Any) -> None:
    tick = make_tick(1)
    store = record(tmp_path / "a.rrd", [tick], meshes=False)
    (strips,) = column(store, paths.CANDIDATES, "LineStrips3D:strips")
    (colours,) = column(store, paths.CANDIDATES, "LineStrips3D:colors")
    hands = robot_pose(tick).from_heading(tick.candidates.hands_b)  # (n, N, 2, 3)
    expected = np.concatenate([hands[:, :, 0], hands[:, :, 1]])
    np.testing.assert_allclose(np.array(strips), expected, atol=1e-6)
    n = len(tick.candidates.values)
    assert colours[:n] == colours[n:]
    best = int(tick.candidates.values.argmax())
    assert [i for i in range(n) if colours[i] == 0xFDE725FF] == [best]


def test_every_view_of_the_blueprint_has_data(tmp_path: Path, make_tick: Any) -> None:
    found = entities(record(tmp_path / "a.rrd", [make_tick(i) for i in range(3)]))
    origins = [view.origin for view in views(blueprint().root_container)]
    assert len(origins) == 19
    for origin in origins:
        assert any(path == origin or path.startswith(f"{origin}/") for path in found), origin


def views(part: Any) -> list[Any]:
    """The views within a container."""
    contents = getattr(part, "contents", None)
    if isinstance(part, Container):
        return [view for inner in contents or () for view in views(inner)]
    return [part]
