"""The simulated low-level robot in lock-step is repeatable bit for bit."""

from __future__ import annotations

import numpy as np

from egovcp.rate import FixedRate
from egovcp.robot.controllers import make_controller
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp.sim.live import EpisodeOutcome, LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_BOX
from egovcp_deploy.robots.base import MotorCommand, proprioception
from egovcp_deploy.robots.fake.command import EpisodeSequencer, FakeG1Config
from tests.support.robots.sim_low_level import SimClock, SimLowLevelRobot

NEUTRAL = np.concatenate([np.zeros(3), ACTION_BOX.neutral])


def play(live: LiveRobot) -> tuple[list[EpisodeOutcome], list[np.ndarray]]:
    """One ball, under a controller at 50 Hz."""
    live.start(Scenario("ball", 4, 0))
    robot = SimLowLevelRobot(live)
    episodes = EpisodeSequencer(
        robot,
        FakeG1Config(gantry=0.3, settle=0.3, pause=1.5),
        iter([Scenario("ball", 4, 0)]),
    )
    clock = SimClock(episodes.step)
    rate = FixedRate(50, clock)
    controller = make_controller("stance")
    controller.reset(proprioception(robot.read(), NEUTRAL)[None])
    rate.start()
    trace: list[np.ndarray] = []
    while not episodes.finished:
        state = robot.read()
        assert state.time_ns == clock.now_ns() == robot.time_ns
        target = controller.step(proprioception(state, NEUTRAL)[None])[0]
        robot.write(MotorCommand(target, STIFFNESS, DAMPING, mode=state.mode))
        picture = robot.camera.read()
        age = clock.now_ns() - picture.time_ns
        assert 0 <= age <= (25_000_000 if clock.now_ns() > 200_000_000 else 200_000_000)
        trace += [state.joint_position, picture.depth]
        assert rate.wait() == 0
    return episodes.outcomes, trace


def test_a_rollout_in_lockstep_repeats_bit_for_bit(live: LiveRobot) -> None:
    (one, first), (two, second) = play(live), play(live)
    assert one[0].ticks == 20
    assert not one[0].fallen
    assert one == two
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_reading_is_measured_once_per_step(live: LiveRobot) -> None:
    live.start(Scenario("ball", 0, 0))
    robot = SimLowLevelRobot(live)
    first = robot.read()
    assert robot.read() is first
    robot.step()
    assert robot.read() is not first
    assert robot.read().time_ns == 5_000_000


def test_sim_clock_takes_whole_steps() -> None:
    steps: list[int] = []
    clock = SimClock(lambda: steps.append(1))
    clock.sleep_until(12_000_000)
    assert (clock.now_ns(), len(steps)) == (12_000_000, 2)
    clock.sleep_until(5)
    clock.sleep_until(20_000_000)
    assert (clock.now_ns(), len(steps)) == (20_000_000, 4)
