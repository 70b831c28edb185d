"""What a ballistic fit is told, and what not."""

import numpy as np
import pytest
import torch
from paths import Flight, errors, fitted, foreseen, prior_of

from egovcp import spec
from egovcp.errors import DataError
from egovcp.model.depth import paint_ball
from egovcp_train.labels.camera import camera_track
from egovcp_train.labels.config import PassingConfig
from egovcp_train.labels.flight import in_picture
from egovcp_train.labels.throw import Path, Throw

CONFIG = PassingConfig(camera_pitch=0.0)
TICKS = 20
START = np.array([3.4, 0.3, 0.4])
VELOCITY = np.array([-3.6, -0.3, 1.0])


def flight(start: np.ndarray = START, velocity: np.ndarray = VELOCITY, seen: int = TICKS) -> Flight:
    """A robot that stands still, and a ball that it sees in its first ``seen`` pictures."""
    state = np.zeros((TICKS, spec.STATE_DIM))
    state[:, spec.STATE_SLICES["projected_gravity"]] = (0.0, 0.0, -1.0)
    t = np.arange(TICKS) * spec.PLANNER_DT
    path = Path(start, velocity, t)
    throw = Throw(np.arange(TICKS), camera_track(state, CONFIG), 0.0, path)
    place = in_picture(throw, CONFIG)
    half = (np.array([spec.DEPTH_COLS, spec.DEPTH_ROWS]) - 1) / 2
    flies = (place[:, 2] > 0).astype(float)
    near = 1 - place[:, 3] / spec.DEPTH_MAX_M
    told = np.stack([*(place[:, [1, 0]] / half - 1).T, near, 2 * flies - 1], -1)
    empty = torch.zeros(TICKS, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    pictures = paint_ball(empty, torch.from_numpy(told).float(), spec.DEPTH_MAX_M)
    rows = np.flatnonzero(flies)[:seen]
    return Flight(throw, pictures, place, rows, path.at(t[rows]))


def throws(count: int) -> list[Flight]:
    rng = np.random.default_rng(0)
    draws = 0.2 * rng.normal(size=(count, 2, 3))
    return [flight(START + place, VELOCITY + speed) for place, speed in draws]


def test_a_path_without_errors_is_found() -> None:
    one = flight()
    found = fitted(one.rows[:3] * spec.PLANNER_DT, one.point[:3], None)
    assert found is not None
    np.testing.assert_allclose([found.position, found.velocity], [START, VELOCITY], atol=1e-9)


def test_one_sighting_is_no_path_but_with_a_prior() -> None:
    one = flight()
    t, point = one.rows[:1] * spec.PLANNER_DT, one.point[:1]
    assert fitted(t, point, None) is None
    found = fitted(t, point, prior_of(throws(30)))
    assert found is not None
    np.testing.assert_allclose(found.position, START, atol=0.05)
    np.testing.assert_allclose(found.velocity, VELOCITY, atol=0.3)


def test_a_prior_takes_throws() -> None:
    with pytest.raises(DataError, match=r"3 throws .* takes 20"):
        prior_of(throws(3))


def test_what_comes_later_is_not_seen() -> None:
    one = flight()
    later = one.rows > 4
    liar = one._replace(point=np.where(later[:, None], one.point + 1.0, one.point))
    for prior in (None, prior_of(throws(30))):
        honest, told = (foreseen(f, 4, 12, prior, CONFIG) for f in (one, liar))
        assert honest is not None
        assert told is not None
        assert torch.equal(honest, told)


def test_a_ball_that_is_foreseen_is_painted_where_it_will_be() -> None:
    fit, repeat, pixels = errors(flight(), 4, 8, None, CONFIG)
    assert pixels > 10
    assert fit / pixels < 60 < 1000 < repeat / pixels
    assert errors(flight(), 4, 8, None, CONFIG)[1] == errors(flight(seen=1), 4, 8, None, CONFIG)[0]


def test_there_is_no_error_where_nothing_flies() -> None:
    one = flight()
    landed = int(np.flatnonzero(one.place[:, 2] > 0)[-1])
    assert not errors(one, landed, 1, None, CONFIG).any()
    assert not errors(one, TICKS - 2, 8, None, CONFIG).any()
