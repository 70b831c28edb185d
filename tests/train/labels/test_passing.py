"""Labels of what is on its way, from pictures alone."""

import dataclasses
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, EpisodeStore
from egovcp.data.mirror import mirror_depth, mirror_passing, mirror_state
from egovcp.errors import EnvironmentFailure
from egovcp.robot.kinematics import LINK_NAMES, link_transforms
from egovcp.sim.config import CameraConfig, EnvConfig, EpisodeConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp.sim.truth import Truth
from egovcp_train.labels import passing
from egovcp_train.labels.camera import camera_track
from egovcp_train.labels.config import PassingConfig
from egovcp_train.labels.passing import label, label_episode
from egovcp_train.labels.throw import find_throw, fit_path

CONFIG = PassingConfig(camera_pitch=0.0)
TICKS, THROW = 40, 8
GRAVITY = np.array([0.0, 0.0, -9.81])


def standing(ticks: int = TICKS) -> np.ndarray:
    """A robot with all joints at zero that does not move."""
    state = np.zeros((ticks, spec.STATE_DIM))
    state[:, spec.STATE_SLICES["projected_gravity"]] = (0.0, 0.0, -1.0)
    return state


def camera_origin(state: np.ndarray) -> np.ndarray:
    """Of the standing robot, in the frame of the labels."""
    return camera_track(state, CONFIG).position[0]


def photograph(ball: np.ndarray, radius: float = 0.1) -> np.ndarray:
    """(48, 64) mm: a disc where a ball at (3,) m in the camera frame is seen, 0 elsewhere."""
    focal = spec.DEPTH_ROWS / 2 / np.tan(CONFIG.vertical_fov / 2)
    rows, cols = np.mgrid[: spec.DEPTH_ROWS, : spec.DEPTH_COLS]
    left = -(cols - (spec.DEPTH_COLS - 1) / 2) / focal * ball[0]
    up = -(rows - (spec.DEPTH_ROWS - 1) / 2) / focal * ball[0]
    inside = np.hypot(left - ball[1], up - ball[2]) < radius
    return np.where(inside, round(1000 * (ball[0] - radius)), 0).astype(np.uint16)


def throw(where: tuple[float, float], flight: float = 0.7) -> np.ndarray:
    """(T, 48, 64) mm: from 3 m ahead through (plane, *where) in ``flight`` seconds."""
    origin = camera_origin(standing())
    start = np.array([3.0, 0.2, 0.3])
    target = np.array([CONFIG.plane, *where])
    velocity = (target - start) / flight - 0.5 * GRAVITY * flight
    depth = np.zeros((TICKS, spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16)
    for t in range(THROW, TICKS):
        s = (t - THROW) * spec.PLANNER_DT
        ball = start + velocity * s + 0.5 * GRAVITY * s * s - origin
        if ball[0] > spec.DEPTH_MIN_M + 0.1:
            depth[t] = photograph(ball)
    return depth


@pytest.mark.parametrize("where", [(0.0, 0.3), (0.35, 0.1), (-0.3, 0.45)])
def test_a_throw_is_labelled_with_where_and_when_it_will_pass(where: tuple[float, float]) -> None:
    label = label_episode(throw(where), standing(), CONFIG)
    on = label[:, 3] > 0
    first = int(np.flatnonzero(on)[0])
    assert THROW <= first <= THROW + 3
    assert on[first : THROW + 17].all()
    np.testing.assert_allclose(label[on, :2], np.tile(where, (on.sum(), 1)), atol=0.06)
    passes = label[on, 2] + np.flatnonzero(on) * spec.PLANNER_DT
    np.testing.assert_allclose(passes, THROW * spec.PLANNER_DT + 0.7, atol=0.04)
    assert label[:, 4].all()
    assert not on[:THROW].any()
    assert not on[THROW + 19 :].any()


def test_a_mirrored_throw_has_the_mirrored_label() -> None:
    depth, state = throw((0.3, 0.2)), standing()
    label = label_episode(depth, state, CONFIG)
    mirrored = label_episode(mirror_depth(depth).copy(), mirror_state(state), CONFIG)
    assert (label[:, 7] > 0).sum() > 8
    np.testing.assert_allclose(mirrored, mirror_passing(label), atol=2e-3)


def test_an_empty_scene_is_known_to_be_empty() -> None:
    empty = np.zeros((TICKS, spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16)
    label = label_episode(empty, standing(), CONFIG)
    assert label[:, 4].all()
    assert not label[:, :4].any()


def test_sightings_without_a_path_are_not_known() -> None:
    """Things that flash up here and there: no label pretends to know what they do."""
    rng = np.random.default_rng(0)
    depth = np.zeros((TICKS, spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16)
    for t in range(10, 20, 2):
        depth[t] = photograph(np.array([*rng.uniform(1.5, 3.5, 1), *rng.uniform(-0.6, 0.6, 2)]))
    label = label_episode(depth, standing(), CONFIG)
    assert not label[:, 3].any()
    assert not label[10:19, 4].any()
    assert label[:10, 4].all()


def test_the_robot_s_own_turning_does_not_bend_the_path() -> None:
    state = standing()
    state[:, spec.STATE_SLICES["angular_velocity"].start + 2] = 1.0  # rad/s about the vertical
    point = np.tile([2.0, 0.0, 0.0], (TICKS, 1))
    ground = camera_track(state, CONFIG).to_ground(point)
    angle = np.arctan2(ground[:, 1], ground[:, 0])
    np.testing.assert_allclose(angle[2:] - angle[1], np.arange(TICKS - 2) * 0.04 + 0.04, atol=1e-6)


def test_the_robot_s_own_sinking_does_not_bend_the_path() -> None:
    """A crouch lowers the camera: measured by the legs, it does not lower what is seen."""
    state = standing(2)
    for joint, angle in (("hip_pitch", -0.6), ("knee", 1.2), ("ankle_pitch", -0.6)):
        for side in ("left", "right"):
            index = spec.JOINT_NAMES.index(f"{side}_{joint}_joint")
            state[:, spec.STATE_SLICES["joint_position"].start + index] = angle
    position, _ = link_transforms(state[:, spec.STATE_SLICES["joint_position"]])
    upright, _ = link_transforms(standing(2)[:, spec.STATE_SLICES["joint_position"]])
    foot = LINK_NAMES.index("left_ankle_roll_link")
    sunk = position[0, foot, 2] - upright[0, foot, 2]
    assert sunk > 0.05
    point = np.array([[2.0, 0.0, 0.0]] * 2)
    lower = camera_track(state, CONFIG).to_ground(point)[0, 2]
    higher = camera_track(standing(2), CONFIG).to_ground(point)[0, 2]
    assert higher - lower == pytest.approx(sunk, abs=1e-6)


def test_a_step_of_the_robot_does_not_bend_the_path() -> None:
    """The pelvis moves over the foot that bears it, whatever the other one does in the air."""
    state = standing(3)
    lifted = {"right_knee": (0.0, 0.6, 0.6), "right_hip_pitch": (0.0, -0.3, -0.6)}
    for joint, angles in {"left_hip_pitch": (0.0, 0.0, 0.1), **lifted}.items():
        index = spec.JOINT_NAMES.index(f"{joint}_joint")
        state[:, spec.STATE_SLICES["joint_position"].start + index] = angles
    position, _ = link_transforms(state[:, spec.STATE_SLICES["joint_position"]])
    bearing = position[:, LINK_NAMES.index("left_ankle_roll_link")]
    pelvis = camera_track(state, CONFIG).pelvis
    assert abs(bearing[2, 0] - bearing[1, 0]) > 0.05
    moved, slid = pelvis[2] - pelvis[1], bearing[1] - bearing[2]
    np.testing.assert_allclose(moved[:2], slid[:2], atol=1e-3)


@pytest.mark.parametrize("age", [0.5, 1.5])
def test_old_pictures_of_a_swaying_robot_are_told_by_their_path(age: float) -> None:
    """The camera nods while a ball flies: taken for young, its pictures show a wavy path."""
    t = np.arange(TICKS)
    nod = 0.08 * np.sin(t * 0.9)
    state = standing()
    state[:, spec.STATE_SLICES["projected_gravity"]] = np.stack(
        [np.sin(nod), np.zeros(TICKS), -np.cos(nod)], -1
    )
    track = camera_track(state, CONFIG).aged(age)
    start, velocity = np.array([3.3, 0.2, 0.3]), np.array([-4.0, -0.2, 3.0])
    depth = np.zeros((TICKS, spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16)
    for row in range(THROW, THROW + 18):
        s = (row - THROW) * spec.PLANNER_DT
        ball = start + velocity * s + 0.5 * GRAVITY * s * s
        place = track.to_camera(np.tile(ball, (TICKS, 1)))[row]
        if place[0] > spec.DEPTH_MIN_M + 0.1:
            depth[row] = photograph(place)
    throw = find_throw(depth, state, CONFIG)
    assert throw.path is not None
    assert throw.age == pytest.approx(age * spec.PLANNER_DT)
    np.testing.assert_allclose(throw.path.at(THROW * spec.PLANNER_DT), start, atol=0.12)


def test_flickers_are_outvoted() -> None:
    t = np.arange(12) * spec.PLANNER_DT
    path = np.array([3.0, 0.0, 0.4]) + np.outer(t, [-4.0, 0.3, 2.5])
    path += 0.5 * GRAVITY * (t * t)[:, None]
    path[[2, 5, 9]] += np.array([1.5, -1.0, 0.5])
    found = fit_path(t, path, CONFIG)
    assert found is not None
    np.testing.assert_allclose(found.velocity, [-4.0, 0.3, 2.5], atol=1e-6)
    assert set(found.seen) == set(np.delete(t, [2, 5, 9]))


def test_the_labels_assume_the_simulator_s_camera() -> None:
    camera, assumed = CameraConfig(), PassingConfig()
    assert assumed.camera_position == camera.position
    assert assumed.vertical_fov == camera.vertical_fov
    assert assumed.camera_pitch == pytest.approx(np.mean(camera.pitch_range))


@pytest.mark.parametrize(("controller", "bound"), [("stance", 0.05), ("walk", 0.09)])
def test_labels_of_simulated_throws_agree_with_the_truth(controller: str, bound: float) -> None:
    """Sway, crouches, noise, holes and delays included; the truth only judges."""
    count = 32
    throws = EpisodeConfig(ticks=34, event_ticks=(2, 4), empty_probability=0.0)
    env = VectorEnv(EnvConfig(controller=controller, ball_episode=throws), count)
    scenarios = [Scenario("ball", 5, i) for i in range(count)]
    observation, walk = env.reset(scenarios), RandomWalk()
    walk.reset(env, scenarios)
    depth, state, truth = [], [], []
    for _ in range(throws.ticks):
        depth.append(observation.depth)
        state.append(observation.state)
        truth.append(env.snapshot())
        observation = env.step(walk.act(env)).observation
    errors = []
    for row in range(count):
        label = label_episode(
            np.array([d[row] for d in depth]), np.array([s[row] for s in state]), PassingConfig()
        )
        on = np.flatnonzero(label[:, 3])
        if len(on):
            first = next(t for t in truth if t.object_active[row])
            errors.append(label[on[0], :2] - _true_crossing(first, row))
    assert len(errors) > 0.9 * count
    centred = np.abs(np.array(errors) - np.median(errors, 0))
    across, up = np.median(centred, 0)
    assert across < bound
    assert up < bound
    assert (centred.max(1) < 0.25).mean() > 0.75


def _true_crossing(truth: Truth, row: int) -> np.ndarray:
    """(y, z above the neutral pelvis) of the ballistic path at the plane."""
    flight = (CONFIG.plane - truth.object_b[row, 0]) / truth.object_velocity_b[row, 0]
    at = truth.object_b[row] + truth.object_velocity_b[row] * flight + 0.5 * GRAVITY * flight**2
    return np.array([at[1], at[2] + truth.pelvis_w[row, 2] - spec.ACTION_BOX.neutral[-1]])


# --- many episodes --------------------------------------------------------------------------
def _thrown(dataset_root: Path) -> EpisodeStore:
    """Six throws, each to another place."""
    made = EpisodeStore.load([DatasetReader.open(DatasetConfig(root=str(dataset_root)))], "train")
    throws = [throw((0.1 * i - 0.2, 0.3)) for i in range(6)]
    return dataclasses.replace(
        made,
        depth=np.concatenate(throws),
        state=np.concatenate([standing().astype(np.float32)] * len(throws)),
        start=np.arange(len(throws)) * TICKS,
        length=np.full(len(throws), TICKS),
    )


def test_several_processes_label_alike(dataset_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = _thrown(dataset_root)
    alone = label(store, CONFIG)
    monkeypatch.setattr(passing, "ALONE", 2)
    monkeypatch.setattr(passing, "_AT_ONCE", 2)
    shared = label(store, CONFIG, workers=2)
    assert alone.passing[:, 3].any()
    assert np.array_equal(shared.passing, alone.passing)
    for i in range(6):
        rows = slice(i * TICKS, (i + 1) * TICKS)
        own = label_episode(store.depth[rows], store.state[rows], CONFIG)
        assert np.array_equal(alone.passing[rows], own)


def _killed(episodes: object, config: PassingConfig) -> list[np.ndarray]:
    os.kill(os.getpid(), signal.SIGKILL)
    return []


def test_a_killed_process_is_said(dataset_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passing, "ALONE", 2)
    monkeypatch.setattr(passing, "_all_labelled", _killed)
    with pytest.raises(EnvironmentFailure, match="try fewer --threads"):
        label(_thrown(dataset_root), CONFIG, workers=2)
