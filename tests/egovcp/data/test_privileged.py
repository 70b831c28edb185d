"""Privileged features: the object as last known, its velocity, and the rewards already paid."""

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data.privileged import DIM, mirror_privileged, privileged_features

POSITION, VELOCITY, KNOWN, AGE, EVENTS = slice(3), slice(3, 6), 6, 7, slice(8, DIM)


def _object(known: list[bool]) -> NDArray[np.float64]:
    """An object that moves from (2, -1, 0.5) m by (-0.1, 0.02, 0) per row; zeros where unknown."""
    rows = np.arange(len(known))[:, None]
    position = np.array([2.0, -1.0, 0.5]) + rows * np.array([-0.1, 0.02, 0.0])
    return np.column_stack([position, np.ones(len(known))]) * np.array(known)[:, None]


def _no_rewards(length: int) -> NDArray[np.float64]:
    return np.zeros((length, len(spec.REWARD_TERMS)))


def test_an_object_that_is_not_known_is_where_it_was_last_known() -> None:
    found = privileged_features(_object([False, True, True, True, False, False]), _no_rewards(6))
    assert found.shape == (6, DIM)
    assert found[:, KNOWN].tolist() == [0, 1, 1, 1, 0, 0]
    assert not found[0, :6].any()
    np.testing.assert_allclose(found[3:, POSITION], [[1.7, -0.94, 0.5]] * 3, atol=1e-6)
    np.testing.assert_allclose(found[:, AGE], [2, 0, 0, 0, 0.04, 0.08], atol=1e-6)


def test_its_velocity_is_that_between_two_rows_that_know_it() -> None:
    found = privileged_features(_object([True, False, True, True, False]), _no_rewards(5))
    expected = np.array([0, 0, 0, 1, 1])[:, None] * np.array([-2.5, 0.5, 0.0])
    np.testing.assert_allclose(found[:, VELOCITY], expected, atol=1e-5)


def test_only_earlier_rewards_count_and_those_of_actions_never() -> None:
    terms = _no_rewards(4)
    terms[:, spec.REWARD_TERMS.index("pose")] = -9.0
    terms[1, spec.REWARD_TERMS.index("hit")] = -0.5
    terms[2, spec.REWARD_TERMS.index("block")] = 1.0
    events = privileged_features(_object([True] * 4), terms)[:, EVENTS]
    order = [name for name in spec.REWARD_TERMS if name not in spec.ACTION_TERMS]
    assert events[:, order.index("hit")].tolist() == [0, 0, -0.5, -0.5]
    assert events[:, order.index("block")].tolist() == [0, 0, 0, 1]
    assert np.abs(events).sum() == 2.0


def test_features_of_a_mirrored_episode_are_mirrored_features() -> None:
    obj, terms = _object([True, True, False, True]), np.ones((4, len(spec.REWARD_TERMS)))
    mirrored = np.column_stack([obj[:, :3] * [1, -1, 1], obj[:, 3]])
    found = privileged_features(mirrored, terms)
    np.testing.assert_allclose(found, mirror_privileged(privileged_features(obj, terms)))
    assert (found != privileged_features(obj, terms)).any()
