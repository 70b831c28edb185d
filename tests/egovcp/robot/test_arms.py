"""Inverse kinematics of both hands, and tracking of hand targets."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp.robot import arms
from egovcp.robot.arms import DT, ReachConfig
from egovcp.robot.geometry import Array

UPRIGHT = np.eye(3)[None]


def _solve(target: Array, iterations: int = 60) -> Array:
    q = np.tile(arms.REST, (len(target), 1, 1))
    for _ in range(iterations):
        q = arms.ik_step(q, arms.reachable(target))
    return q


@pytest.mark.parametrize(
    "left",
    [
        (0.35, 0.12, 0.42),  # before the face
        (0.38, 0.15, 0.20),  # before the chest
        (0.25, 0.15, -0.05),  # low before the hips
        (0.15, 0.45, 0.25),  # out to the side
        (0.30, -0.02, 0.25),  # across the middle
    ],
)
def test_reachable_targets_are_reached(left: tuple[float, float, float]) -> None:
    target = np.array([[left, (left[0], -left[1], left[2])]])
    error = arms.forward(_solve(target)).palm - target
    assert np.linalg.norm(error, axis=-1).max() < 0.015


def test_rest_is_a_fixed_point() -> None:
    rest = arms.REST[None]
    moved = arms.ik_step(rest, arms.forward(rest).palm)
    np.testing.assert_allclose(moved, rest, atol=1e-12)


def test_mirrored_targets_give_mirrored_arms() -> None:
    target = np.array([[[0.3, 0.2, 0.3], [0.3, -0.2, 0.3]]])
    left, right = _solve(target)[0]
    np.testing.assert_allclose(left, right * [1, -1, -1, 1, -1, 1, -1], atol=2e-3)


def test_wild_targets_stay_finite_and_within_joint_limits() -> None:
    rng = np.random.default_rng(0)
    targets = rng.normal(scale=3.0, size=(64, 2, 3))
    targets[0] = arms.SHOULDER  # no direction to pull in
    targets[1] = 0.0
    q = _solve(targets)
    assert np.all((q >= arms.LOWER) & (q <= arms.UPPER))


def test_targets_are_pushed_out_of_the_trunk_and_into_reach() -> None:
    inside = np.array([[[0.0, 0.0, 0.2], [2.0, -0.2, 0.3]]])
    out = arms.reachable(inside)[0]
    assert out[0, 0] > 0.12
    assert np.linalg.norm(out[1] - arms.SHOULDER[1]) < 0.465


def test_references_respect_speed_and_acceleration() -> None:
    config = ReachConfig(speed=3.0, acceleration=40.0)
    memory = arms.ArmReference.at_rest(arms.REST.reshape(1, 14))
    rates = [memory.rate]
    for tick in range(40):
        side = 0.4 if tick < 20 else 0.0
        arms.track_hands(memory, np.array([[[side, 0.2, 0.4], [side, -0.2, 0.4]]]), UPRIGHT, config)
        rates.append(memory.rate)
    rate = np.array(rates)
    assert np.abs(rate).max() <= 3.0 + 1e-12
    assert np.abs(np.diff(rate, axis=0)).max() <= 40.0 * DT + 1e-12


def test_momentum_is_the_time_derivative_of_the_first_moment() -> None:
    memory = arms.ArmReference.at_rest(arms.REST.reshape(1, 14))
    before = memory.moment
    hands = np.array([[[0.4, 0.2, 0.4], [0.2, -0.3, 0.1]]])
    arms.track_hands(memory, hands, UPRIGHT, ReachConfig())
    np.testing.assert_allclose(memory.linear, (memory.moment - before) / DT, atol=1e-9)
    assert np.abs(memory.linear).max() > 0.1


@pytest.mark.parametrize("frequency", [5.0, 20.0, 25.0])
def test_a_critically_damped_reference_arrives_without_overshoot(frequency: float) -> None:
    config = ReachConfig(speed=100.0, acceleration=1e4, frequency=frequency)
    memory = arms.ArmReference.at_rest(arms.REST.reshape(1, 14))
    goal = arms.REST[None] + 0.3
    memory.goal = goal
    positions = []
    for _ in range(150):
        arms._smooth(memory, config)
        positions.append(memory.joints[0, 0, 0])
    assert np.all(np.diff(positions) >= -1e-12)
    assert positions[-1] == pytest.approx(goal[0, 0, 0], abs=1e-3)


def test_a_frequency_changes_the_identity_and_its_default_does_not() -> None:
    assert "frequency" not in repr(ReachConfig())
    assert repr(ReachConfig(frequency=20.0)) != repr(ReachConfig())
