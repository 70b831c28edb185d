"""No target beyond its bounds leaves the process, whatever planner and controller give."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.robot.kinematics import JOINT_LOWER, JOINT_UPPER, TARGET_HIGH, TARGET_LOW
from egovcp_deploy.live import motors
from egovcp_deploy.robots.base import MotorCommand
from egovcp_deploy.robots.wire import decode_command, encode_command

Array = NDArray[np.float64]
GAIN = np.full(29, 40.0)
_EXTREMES = (np.nan, np.inf, -np.inf, 1e300, -1e300, 1e30, 1e9, -1e9, 3.0, -3.0, 0.0)


def wild(rng: np.random.Generator) -> Array:
    """(29,) random numbers, extremes among them."""
    values = rng.normal(0, 10.0 ** rng.integers(-2, 4), 29)
    return np.where(rng.random(29) < 0.3, rng.choice(_EXTREMES, 29), values)


def sent(command: MotorCommand) -> Array:
    """(29,) targets as they arrive."""
    return decode_command(encode_command(command)).motors.position


def test_targets_exceed_joint_ranges_by_0_1_to_0_6_rad() -> None:
    below, above = JOINT_LOWER - TARGET_LOW, TARGET_HIGH - JOINT_UPPER
    for slack in (below, above):
        assert (slack >= 0.0999).all()
        assert (slack <= 0.6001).all()
    assert (np.minimum(below, above) < 0.11).sum() >= 18  # a range that is not needed is not given


@pytest.mark.parametrize("make", ["following", "coming_in", "damped"])
def test_targets_are_finite_and_bounded_whatever_comes(make: str) -> None:
    rng = np.random.default_rng(0)
    build: dict[str, Callable[[], MotorCommand]] = {
        "following": lambda: motors.following(wild(rng), GAIN, GAIN, 5),
        "coming_in": lambda: motors.coming_in(
            wild(rng), wild(rng), GAIN, GAIN, float(rng.normal(0, 3)), 5
        ),
        "damped": lambda: motors.damped(wild(rng), 5),
    }
    for _ in range(500):
        position = sent(build[make]())
        assert np.isfinite(position).all()
        assert (position >= TARGET_LOW - 1e-6).all()
        assert (position <= TARGET_HIGH + 1e-6).all()
