"""The base moves only while someone asks for it, within bounds, and never abruptly."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp_deploy.pilot.velocity import VelocityCommand, VelocityLimits

TICK_NS = 20_000_000


def test_a_wish_is_bounded_and_ramped() -> None:
    command, limits = VelocityCommand(), VelocityLimits()
    last = command.at(0)
    for k in range(1, 101):
        command.wish(k * TICK_NS, (9.0, -9.0, 9.0))
        now = command.at(k * TICK_NS)
        assert (np.abs(now - last) <= np.array(limits.ramp) * 0.02 + 1e-12).all()
        last = now
    np.testing.assert_allclose(last, (limits.high[0], limits.low[1], limits.high[2]))


def test_silence_for_half_a_second_stops_the_robot() -> None:
    command = VelocityCommand()
    for k in range(50):
        command.wish(k * TICK_NS, (0.4, 0.0, 0.0))
        command.at(k * TICK_NS)
    silent = [command.at((50 + k) * TICK_NS)[0] for k in range(60)]
    assert silent[0] == pytest.approx(0.4)
    assert silent[-1] == 0.0
    assert (np.diff(silent) <= 0).all()


def test_where_moving_is_not_allowed_the_velocity_ramps_to_zero() -> None:
    command = VelocityCommand()
    for k in range(50):
        command.wish(k * TICK_NS, (0.4, 0.0, 0.0))
        command.at(k * TICK_NS)
    command.wish(50 * TICK_NS, (0.4, 0.0, 0.0))
    assert 0.0 < command.at(50 * TICK_NS, allowed=False)[0] < 0.4
    for k in range(51, 90):
        command.wish(k * TICK_NS, (0.4, 0.0, 0.0))
        last = command.at(k * TICK_NS, allowed=False)
    np.testing.assert_array_equal(last, 0.0)


@pytest.mark.parametrize("wish", [(np.nan, 0.0, 0.0), (np.inf, 0.0, 0.0), (0.1, 0.1)])
def test_a_wish_that_is_no_velocity_is_ignored(wish: tuple[float, ...]) -> None:
    command = VelocityCommand()
    command.at(0)
    command.wish(TICK_NS, wish)
    np.testing.assert_array_equal(command.at(TICK_NS), 0.0)
