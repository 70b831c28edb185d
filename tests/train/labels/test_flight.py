"""The pixels of what flies: the ball's, all of them, and no other's."""

import numpy as np
import pytest
import torch

from egovcp import spec
from egovcp.model.depth import nearness, thing_pixels
from egovcp_train.labels.camera import camera_track
from egovcp_train.labels.config import PassingConfig
from egovcp_train.labels.flight import STOP
from egovcp_train.labels.passing import label_episode

CONFIG = PassingConfig(camera_pitch=0.0)
TICKS, THROW = 40, 8
GRAVITY = np.array([0.0, 0.0, -9.81])


def _standing(ticks: int = TICKS) -> np.ndarray:
    state = np.zeros((ticks, spec.STATE_DIM))
    state[:, spec.STATE_SLICES["projected_gravity"]] = (0.0, 0.0, -1.0)
    return state


def _disc(ball: np.ndarray) -> np.ndarray:
    """(48, 64) where a ball at (3,) m in the camera frame covers the picture."""
    rows, cols = np.mgrid[: spec.DEPTH_ROWS, : spec.DEPTH_COLS]
    left = -(cols - (spec.DEPTH_COLS - 1) / 2) / CONFIG.focal * ball[0]
    up = -(rows - (spec.DEPTH_ROWS - 1) / 2) / CONFIG.focal * ball[0]
    return np.hypot(left - ball[1], up - ball[2]) < CONFIG.radius


def _throw(speed: float, flight: float = 0.7) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pictures (T, 48, 64) mm before a wall 4 m away, the ball's pixels, and its x (T,) m."""
    origin = camera_track(_standing(), CONFIG).position[0]
    start = np.array([CONFIG.plane + speed * flight, 0.2, 0.3])
    velocity = np.array([-speed, -0.2, 0.5 * 9.81 * flight])
    depth = np.full((TICKS, spec.DEPTH_ROWS, spec.DEPTH_COLS), 4000, np.uint16)
    ball, x = np.zeros(depth.shape, np.bool_), np.full(TICKS, np.inf)
    for t in range(THROW, TICKS):
        s = (t - THROW) * spec.PLANNER_DT
        place = start + velocity * s + 0.5 * GRAVITY * s * s
        if place[0] < CONFIG.plane:
            break
        x[t] = place[0]
        ball[t] = _disc(place - origin)
        depth[t][ball[t]] = round(1000 * (place[0] - origin[0] - CONFIG.radius))
    return depth, ball, x


def flight_pixels(depth: np.ndarray, state: np.ndarray, config: PassingConfig) -> np.ndarray:
    """(T, 48, 64), as the losses and the evaluation find them."""
    place = torch.from_numpy(label_episode(depth, state, config)[:, spec.IN_PICTURE])
    near = nearness(torch.from_numpy(depth.astype(np.int32)), spec.DEPTH_MAX_M)
    return thing_pixels(near, place, spec.DEPTH_MAX_M).numpy()


def test_the_pixels_of_a_throw_are_the_ball_s() -> None:
    depth, ball, x = _throw(speed=3.8)
    found = flight_pixels(depth, _standing(), CONFIG)
    rows = np.flatnonzero(found.any((1, 2)))
    assert rows[0] <= THROW + 3
    judged = (np.arange(TICKS) >= rows[0]) & (x > STOP + 0.1) & np.isfinite(x)
    assert judged.sum() > 10
    assert not found[~ball].any()
    assert found[judged][ball[judged]].mean() > 0.95


def test_what_is_near_the_hands_is_not_judged() -> None:
    depth, _, x = _throw(speed=3.8)
    assert not flight_pixels(depth, _standing(), CONFIG)[x < STOP - 0.1].any()


def test_a_hand_beside_the_ball_is_not_the_ball() -> None:
    depth, ball, _ = _throw(speed=3.8)
    hand = np.zeros_like(ball)
    hand[:, 30:, 30:] = True
    depth[hand & ~ball] = 450
    assert not flight_pixels(depth, _standing(), CONFIG)[hand & ~ball].any()


@pytest.mark.parametrize("level", [0, 2000])
def test_where_nothing_flies_there_are_no_pixels(level: int) -> None:
    depth = np.full((TICKS, spec.DEPTH_ROWS, spec.DEPTH_COLS), level, np.uint16)
    assert not flight_pixels(depth, _standing(), CONFIG).any()


def test_the_camera_s_view_leads_back_to_the_ground() -> None:
    """While the robot turns, leans and crouches."""
    rng = np.random.default_rng(0)
    state = _standing()
    state += 0.2 * rng.standard_normal(state.shape)
    gravity = spec.STATE_SLICES["projected_gravity"]
    state[:, gravity] /= np.linalg.norm(state[:, gravity], axis=1, keepdims=True)
    track = camera_track(state, PassingConfig()).aged(1.0)
    point = rng.standard_normal((TICKS, 3))
    np.testing.assert_allclose(track.to_ground(track.to_camera(point)), point, atol=1e-9)
