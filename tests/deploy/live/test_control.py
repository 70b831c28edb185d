"""The 50 Hz control loop, its motor commands and its velocity on a simulated body."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.robot.kinematics import JOINT_LOWER, JOINT_UPPER, TARGET_HIGH, TARGET_LOW
from egovcp.spec import ACTION_BOX, COMMAND_SLICE, STATE_SLICES
from egovcp_deploy.live.control import (
    VELOCITY_HIGH,
    VELOCITY_LOW,
    VELOCITY_RAMP,
    VelocityCommand,
    damping_command,
    ramp_command,
)
from egovcp_deploy.pilot.states import OperatorRequest, State
from egovcp_deploy.robots.base import MotorCommand
from egovcp_deploy.robots.wire import decode_command, encode_command

from .conftest import Rig

Make = Callable[..., Rig]


def limp(command: MotorCommand) -> bool:
    return not command.stiffness.any()


def assert_sane(commands: list[MotorCommand]) -> None:
    """Every command that was ever written is finite and within what the joints can do."""
    for command in commands:
        for part in (command.position, command.stiffness, command.damping):
            assert np.isfinite(part).all()
        assert (command.stiffness >= 0).all()
        assert (command.damping > 0).all()
        if not limp(command):
            assert (command.position >= TARGET_LOW - 1e-9).all()
            assert (command.position <= TARGET_HIGH + 1e-9).all()


def test_the_motors_are_damped_until_stand_is_requested(make_rig: Make) -> None:
    rig = make_rig()
    rig.run(1.0)
    assert set(rig.states) == {State.INIT}
    assert all(limp(command) for command in rig.body.commands)
    assert len(rig.body.commands) == 50


def test_the_gains_ramp_in_without_a_jump(make_rig: Make) -> None:
    rig = make_rig()
    rig.run(0.1)
    before = len(rig.body.commands)
    rig.run(3.1, OperatorRequest.STAND)
    gains = np.array([command.stiffness[0] for command in rig.body.commands[before:]])
    assert (np.diff(gains) >= 0).all()
    assert np.diff(gains).max() < gains[-1] / 100
    assert gains[0] < gains[-1] / 100
    targets = np.stack([command.position for command in rig.body.commands[before:]])
    assert np.abs(np.diff(targets, axis=0)).max() < 0.2


def test_the_robot_stands_and_reaches_the_planned_targets(make_rig: Make) -> None:
    rig = make_rig()
    rig.go()
    rig.run(2.0)
    assert rig.loop.state is State.RUN
    assert rig.robot.robot.pelvis_height > 0.7
    np.testing.assert_allclose(rig.loop.pilot.sent[:6], 0.5)
    palms = rig.robot.robot.palms_b
    wanted = ACTION_BOX.to_metric(rig.loop.pilot.sent)[:6].reshape(2, 3)
    assert np.abs(palms - wanted).max() < 0.1
    assert_sane(rig.body.commands)


@pytest.mark.parametrize(
    ("delay_ms", "offset"),
    [
        (10, 0.02),
        (90, 0.0),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in product((10, 30, 90), (0.0, 0.02))),
    ],
)
def test_the_recurrence_begins_at_run_and_gets_the_sent_actions(
    make_rig: Make, delay_ms: int, offset: float
) -> None:
    slow = [10]
    rig = make_rig(lambda tick: slow[0])
    rig.stand()
    slow[0] = delay_ms
    rig.run(offset)
    resets = rig.policy.resets
    seen = len(rig.policy.seen)
    rig.run(1.0, OperatorRequest.RUN)
    assert rig.policy.resets == resets + 1
    states = np.stack(rig.policy.seen[seen:])
    commands = states[:, COMMAND_SLICE]
    np.testing.assert_allclose(commands[0, 3:], ACTION_BOX.neutral, atol=1e-6)
    sent = np.stack(rig.policy.sent)[-len(states) + 1 :]  # the first observation has none
    np.testing.assert_allclose(commands[1:, 3:], ACTION_BOX.to_metric(sent), atol=1e-6)


@pytest.mark.parametrize(
    "delay_ms", [38, *(pytest.param(ms, marks=pytest.mark.slow) for ms in (5, 15, 30))]
)
def test_a_plan_that_is_ready_within_its_tick_is_never_missed(
    make_rig: Make, delay_ms: int
) -> None:
    rig = make_rig(lambda tick: delay_ms)
    rig.go()
    rig.run(2.0)
    assert rig.loop.pilot.plans.misses == 0
    assert set(rig.states[-100:]) == {State.RUN}


@pytest.mark.parametrize(
    "delay_ms", [100, *(pytest.param(ms, marks=pytest.mark.slow) for ms in (60, 200, 400))]
)
def test_a_slow_planner_holds_the_robot_and_never_damps_it(make_rig: Make, delay_ms: int) -> None:
    slow = [False]
    rig = make_rig(lambda tick: delay_ms if slow[0] else 10)
    rig.go()
    slow[0] = True
    rig.run(4.0)
    assert State.DAMP not in rig.states
    assert State.HOLD in rig.states
    assert rig.robot.robot.pelvis_height > 0.7
    assert_sane(rig.body.commands)
    slow[0] = False
    rig.run(2.0)
    assert rig.loop.state is State.RUN


def test_a_silent_planner_holds_within_200_ms_and_the_hands_ease(make_rig: Make) -> None:
    dead = [False]
    rig = make_rig(lambda tick: 10**6 if dead[0] else 10)
    rig.go()
    dead[0] = True
    start = len(rig.states)
    rig.run(3.0)
    assert (rig.states[start:].index(State.HOLD) + 1) * 20 <= 200
    np.testing.assert_allclose(rig.loop.pilot.sent, 0.0, atol=1e-9)
    assert rig.robot.robot.pelvis_height > 0.7


@pytest.mark.parametrize(("ms", "worst"), [(60, State.RUN), (160, State.HOLD), (300, State.DAMP)])
def test_frozen_proprioception(make_rig: Make, ms: int, worst: State) -> None:
    rig = make_rig(level=0.0)
    rig.go()
    start = len(rig.states)
    rig.faults.frozen = True
    rig.run(ms / 1e3)
    rig.faults.frozen = False
    rig.run(2.0)
    seen = set(rig.states[start:])
    order = [State.RUN, State.HOLD, State.DAMP]
    assert max(seen, key=order.index) is worst
    if worst is State.DAMP:
        assert (rig.states[start:].index(State.DAMP) + 1) * 20 <= 240
        assert all(limp(command) for command in rig.body.commands[-50:])
    else:
        assert rig.loop.state is State.RUN


def test_readings_that_are_not_finite_are_ignored(make_rig: Make) -> None:
    rig = make_rig(level=0.0)
    rig.go()
    rig.faults.nan = True
    rig.run(0.08)
    assert rig.loop.state is State.RUN
    rig.faults.nan = False
    rig.run(0.5)
    assert rig.loop.state is State.RUN
    rig.faults.nan = True
    rig.run(0.4)
    assert rig.loop.state is State.DAMP
    assert np.isfinite(np.stack(rig.policy.seen)).all()
    assert_sane(rig.body.commands)


def test_a_frozen_camera_holds_until_images_return(make_rig: Make) -> None:
    rig = make_rig()
    rig.go()
    rig.faults.blind = True
    rig.run(0.5)
    assert rig.loop.state is State.HOLD
    rig.faults.blind = False
    rig.run(2.0)
    assert rig.loop.state is State.RUN


def test_a_falling_robot_is_damped_within_60_ms_for_good(make_rig: Make) -> None:
    rig = make_rig(level=0.0)
    rig.go()
    start = len(rig.states)
    tilts: list[float] = []

    def each(tick: int) -> None:
        if tick == 0:
            rig.robot.push(np.array([0.0, 3.0, 0.0]))
        tilts.append(rig.robot.robot.tilt)

    rig.run(2.0, each=each)
    tilted = next(k for k, tilt in enumerate(tilts) if tilt > 1.0)
    damped = rig.states[start:].index(State.DAMP)
    assert (damped - tilted) * 20 <= 60
    assert set(rig.states[start + damped :]) == {State.DAMP}
    for request in OperatorRequest:
        rig.run(0.1, request)
    assert rig.loop.state is State.DAMP
    assert all(limp(command) for command in rig.body.commands[start + damped :])


def test_targets_that_are_not_finite_damp_in_the_same_tick(
    make_rig: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig()
    rig.go()
    before = len(rig.body.commands)

    def broken(state: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.full((1, 29), np.nan)

    monkeypatch.setattr(rig.controller, "step", broken)
    rig.run(0.1)
    assert rig.loop.state is State.DAMP
    assert all(limp(command) for command in rig.body.commands[before:])
    assert_sane(rig.body.commands)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
def test_targets_stay_in_bounds_for_any_network_output(
    make_rig: Make, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rig = make_rig()
    rig.go()
    before = len(rig.body.commands)

    def wild(state: NDArray[np.floating]) -> NDArray[np.float64]:
        """The policy in the controller, and now and then a number that is none."""
        target = rng.normal(0, 10.0 ** rng.integers(-1, 6), (1, 29))
        if rng.random() < 0.05:
            target[0, rng.integers(29)] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
        return target

    def plan(tick: int) -> None:
        rig.policy.level = float(rng.choice([np.nan, np.inf, 1e30, -1e30, rng.normal()]))

    monkeypatch.setattr(rig.controller, "step", wild)
    rig.run(1.0, each=plan)
    assert len(rig.body.commands) == before + 50
    assert_sane(rig.body.commands)
    for command in rig.body.commands:
        encode_command(command)  # refuses what is beyond the bounds


def test_another_publisher_prevents_arming(make_rig: Make) -> None:
    rig = make_rig()
    rig.faults.refusal = "another publisher is alive"
    rig.run(0.1)
    rig.run(0.5, OperatorRequest.STAND)
    assert rig.loop.state is State.INIT
    assert rig.body.commands == [], "it may balance the robot"


def test_the_emergency_stop_damps_a_robot_that_another_program_commands(make_rig: Make) -> None:
    rig = make_rig()
    rig.faults.refusal = "another publisher is alive"
    rig.run(0.1)
    rig.run(0.1, OperatorRequest.ESTOP)
    assert len(rig.body.commands) == 5
    assert all(limp(command) for command in rig.body.commands)


def test_commands_end_when_another_program_begins_to_command_before_the_robot_stands(
    make_rig: Make,
) -> None:
    rig = make_rig()
    rig.run(0.1)
    rig.faults.refusal = "another publisher is alive"
    rig.run(0.1)
    assert len(rig.body.commands) == 5


def test_the_operators_velocity_is_sent_only_while_running(make_rig: Make) -> None:
    rig = make_rig(level=0.0)
    rig.stand()
    rig.run(0.4, velocity=(0.2, 0.0, 0.0))
    assert rig.policy.seen[-1][STATE_SLICES["command_velocity"]][0] == 0.0
    rig.run(0.5, OperatorRequest.RUN)
    rig.run(0.4, velocity=(0.2, 0.0, 0.0))
    assert rig.policy.seen[-1][STATE_SLICES["command_velocity"]][0] == pytest.approx(0.2)
    rig.run(1.5)  # the operator has fallen silent
    assert rig.policy.seen[-1][STATE_SLICES["command_velocity"]][0] == 0.0


def test_a_hot_motor_prevents_arming(make_rig: Make) -> None:
    rig = make_rig()
    rig.faults.hot = 75.0
    rig.run(0.1)
    rig.run(3.1, OperatorRequest.STAND)
    assert rig.loop.state is State.INIT, "standing up is refused already"
    rig.faults.hot = 60.0
    rig.stand()
    rig.faults.hot = 75.0
    rig.run(0.2)
    rig.run(0.5, OperatorRequest.RUN)
    assert rig.loop.state is State.ARMED
    assert any("left_knee_joint is at 75 deg C" in line for line in events_of(rig))


def test_a_motor_that_overheats_holds_the_robot_until_it_has_cooled(make_rig: Make) -> None:
    rig = make_rig()
    rig.faults.hot = 40.0
    rig.go()
    rig.faults.hot = 85.0
    rig.run(1.0)
    assert rig.loop.state is State.HOLD
    reason = rig.loop.pilot.supervisor.reason
    assert "left_knee_joint is too hot: 85 deg C; let the robot down" in reason
    rig.run(2.0)
    assert rig.loop.state is State.HOLD
    rig.faults.hot = 50.0
    rig.run(1.5)
    assert rig.loop.state is State.RUN


def test_a_motor_that_drops_out_damps_the_robot_and_is_named(make_rig: Make) -> None:
    rig = make_rig()
    rig.go()
    rig.faults.dropped = True
    begin = len(rig.states)
    rig.run(0.6)
    assert rig.loop.state is State.DAMP
    assert "motor of left_knee_joint does not follow" in rig.loop.pilot.supervisor.reason
    assert rig.states.index(State.DAMP) - begin <= 15
    assert_sane(rig.body.commands)


def test_pushes_and_reaches_raise_no_motor_faults(make_rig: Make) -> None:
    rig = make_rig(level=0.9)
    rig.faults.hot = 40.0
    rig.go()
    for push in ((0.3, 0.0), (-0.2, 0.2)):
        rig.robot.push(np.array([*push, 0.0]))
        rig.run(1.5)
    assert State.DAMP not in rig.states
    assert not any("motor of" in line for line in events_of(rig))


def events_of(rig: Rig) -> list[str]:
    """All that the loop has reported, and what it would report next."""
    return [*rig.events, *rig.loop.pilot.take_events()]


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


@pytest.mark.parametrize("make", ["position", "ramp", "damping"])
def test_motor_commands_are_finite_and_bounded_for_any_input(make: str) -> None:
    rng = np.random.default_rng(0)
    build: dict[str, Callable[[], MotorCommand]] = {
        "position": lambda: ramp_command(wild(rng), wild(rng), GAIN, GAIN, 1.0, 5),
        "ramp": lambda: ramp_command(wild(rng), wild(rng), GAIN, GAIN, float(rng.normal(0, 3)), 5),
        "damping": lambda: damping_command(wild(rng), 5),
    }
    for _ in range(500):
        position = sent(build[make]())
        assert np.isfinite(position).all()
        assert (position >= TARGET_LOW - 1e-6).all()
        assert (position <= TARGET_HIGH + 1e-6).all()


TICK_NS = 20_000_000


def test_the_velocity_is_bounded_and_ramped() -> None:
    command = VelocityCommand()
    last = command.at(0)
    for k in range(1, 101):
        command.set_target(k * TICK_NS, (9.0, -9.0, 9.0))
        now = command.at(k * TICK_NS)
        assert (np.abs(now - last) <= np.array(VELOCITY_RAMP) * 0.02 + 1e-12).all()
        last = now
    np.testing.assert_allclose(last, (VELOCITY_HIGH[0], VELOCITY_LOW[1], VELOCITY_HIGH[2]))


def test_a_velocity_outside_the_bounds_is_reported_once() -> None:
    command = VelocityCommand()
    assert command.set_target(0, (0.4, 0.0, 0.0)) == ""
    warning = command.set_target(1, (2.0, 0.0, -0.1))
    assert "(2, 0, -0.1)" in warning
    assert "(0.8, 0, -0.1) is commanded" in warning
    assert command.set_target(2, (2.0, 0.0, 0.0)) == ""


def test_silence_for_half_a_second_stops_the_robot() -> None:
    command = VelocityCommand()
    for k in range(50):
        command.set_target(k * TICK_NS, (0.4, 0.0, 0.0))
        command.at(k * TICK_NS)
    silent = [command.at((50 + k) * TICK_NS)[0] for k in range(60)]
    assert silent[0] == pytest.approx(0.4)
    assert silent[-1] == 0.0
    assert (np.diff(silent) <= 0).all()


def test_a_disallowed_velocity_ramps_to_zero() -> None:
    command = VelocityCommand()
    for k in range(50):
        command.set_target(k * TICK_NS, (0.4, 0.0, 0.0))
        command.at(k * TICK_NS)
    command.set_target(50 * TICK_NS, (0.4, 0.0, 0.0))
    assert 0.0 < command.at(50 * TICK_NS, allowed=False)[0] < 0.4
    for k in range(51, 90):
        command.set_target(k * TICK_NS, (0.4, 0.0, 0.0))
        last = command.at(k * TICK_NS, allowed=False)
    np.testing.assert_array_equal(last, 0.0)


@pytest.mark.parametrize("wish", [(np.nan, 0.0, 0.0), (np.inf, 0.0, 0.0), (0.1, 0.1)])
def test_an_invalid_velocity_is_ignored(wish: tuple[float, ...]) -> None:
    command = VelocityCommand()
    command.at(0)
    command.set_target(TICK_NS, wish)
    np.testing.assert_array_equal(command.at(TICK_NS), 0.0)
