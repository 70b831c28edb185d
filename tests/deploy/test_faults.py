"""Faults injected into the lock-step loop of a simulated robot: what happens, and how soon."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.log.tick import CameraView, Tick
from egovcp.plan import PolicyStep
from egovcp.robot_spec import RobotSpec
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT
from egovcp_deploy.pilot.pilot import HOLD_RATE, Pilot
from egovcp_deploy.pilot.planner import PlannerRunner
from egovcp_deploy.pilot.states import Facts, OperatorRequest, State
from egovcp_deploy.robots.base import ActionResult, RobotObservation
from egovcp_deploy.robots.sim import SimRobot
from egovcp_deploy.rollouts import run_rollout
from tests.support.lockstep import DelayedPlanner
from tests.support.sinks import MemorySink

MS = 1_000_000
TICK_MS = 40
TICKS = 75


class Steady:
    """Plans the same reach always; ``broken`` makes its plan unusable."""

    def __init__(self, level: float = 0.5, broken: Callable[[int], float | None] = lambda k: None):
        self._level, self._broken, self._count = level, broken, 0

    def reset(self) -> None:
        pass

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        level = self._broken(self._count)
        self._count += 1
        plan = np.full((1, 4, ACTION_DIM), self._level if level is None else level, np.float32)
        plan[..., -1] = 0.0  # stay upright
        return PolicyStep(plan[:, 0], plan, iterations=1)

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        pass

    def advance(self, sent: NDArray[np.floating]) -> None:
        pass


class Disturbed:
    """A simulated robot whose readings or body are tampered with, by tick."""

    def __init__(
        self, robot: SimRobot, tamper: Callable[[int, RobotObservation, SimRobot], RobotObservation]
    ) -> None:
        self._robot, self._tamper, self.tick, self.damped_at = robot, tamper, 0, -1

    @property
    def controller_id(self) -> str:
        return self._robot.controller_id

    @property
    def camera(self) -> CameraView:
        return self._robot.camera

    @property
    def spec(self) -> RobotSpec:
        return self._robot.spec

    def start(self, episode: int) -> None:
        self.tick, self.damped_at = 0, -1
        self._robot.start(episode)

    def observe(self) -> RobotObservation:
        return self._tamper(self.tick, self._robot.observe(), self._robot)

    def act(self, action: NDArray[np.float64]) -> ActionResult:
        assert np.isfinite(action).all()
        assert np.abs(action).max() <= 1.0
        self.tick += 1
        outcome = self._robot.act(action)
        # A real robot has no task that ends; the rollout ends after 3 s.
        return replace(outcome, terminated=False, truncated=self.tick >= TICKS)

    def damp(self) -> None:
        self.damped_at = self.tick
        self._robot.damp()

    def close(self) -> None:
        self._robot.close()


def untouched(tick: int, sensed: RobotObservation, robot: SimRobot) -> RobotObservation:
    return sensed


@pytest.fixture(scope="module")
def sim() -> Iterator[SimRobot]:
    """Nothing is thrown, and an episode lasts 3 s."""
    quiet = EpisodeConfig(ticks=TICKS, event_ticks=(70, 70), empty_probability=1.0)
    robot = SimRobot(EnvConfig(controller="stance", ball_episode=quiet), "ball", seed=0)
    yield robot
    robot.close()


def play(
    sim: SimRobot,
    policy: Steady,
    tamper: Callable[[int, RobotObservation, SimRobot], RobotObservation] = untouched,
    delay_ms: Callable[[int], int] = lambda tick: 0,
    operator: Callable[[int], OperatorRequest | None] = lambda tick: None,
) -> tuple[list[Tick], Disturbed]:
    robot, memory = Disturbed(sim, tamper), MemorySink()
    planner = DelayedPlanner(PlannerRunner(policy), lambda tick: delay_ms(tick) * MS)
    update_state = Pilot.update_state

    def operated(pilot: Pilot, facts: Facts, request: OperatorRequest | None = None) -> State:
        return update_state(pilot, facts, request or operator(robot.tick))

    robot.start(0)
    with mock.patch.object(Pilot, "update_state", operated):
        run_rollout(planner, robot, memory)
    return memory.ticks, robot


def modes(ticks: list[Tick]) -> list[str]:
    return [tick.mode for tick in ticks]


def assert_gentle(ticks: list[Tick]) -> None:
    sent = np.stack([np.zeros(ACTION_DIM), *(tick.action_sent for tick in ticks)])
    assert np.isfinite(sent).all()
    assert np.abs(sent).max() <= 1.0
    assert np.abs(np.diff(sent, axis=0)).max() <= ACTION_RATE_LIMIT + 1e-9


@pytest.mark.parametrize("delay", [0, 20, 40, 60, 100, 200, 400])
def test_a_late_planner_is_bridged_or_held(sim: SimRobot, delay: int) -> None:
    ticks, robot = play(sim, Steady(), delay_ms=lambda tick: delay)
    assert_gentle(ticks)
    assert robot.damped_at == -1
    if delay <= TICK_MS:
        assert set(modes(ticks)) == {State.RUN}
        np.testing.assert_allclose(ticks[-1].action_sent[:6], 0.5)
    elif delay >= 200:
        held = modes(ticks).index(State.HOLD)
        assert held * TICK_MS <= 200 + TICK_MS  # nothing is known to be wrong before
        assert ticks[-1].mode == State.HOLD
        np.testing.assert_allclose(ticks[-1].action_sent, 0.0, atol=1e-9)


def test_one_long_plan_is_bridged_by_the_plan_before(sim: SimRobot) -> None:
    ticks, _ = play(sim, Steady(), delay_ms=lambda tick: 130 if tick == 30 else 0)
    assert set(modes(ticks)) == {State.RUN}
    np.testing.assert_allclose([t.action_sent[0] for t in ticks[10:]], 0.5)


def test_a_planner_that_stops_is_noticed_in_200_ms_and_the_hands_ease(sim: SimRobot) -> None:
    ticks, robot = play(sim, Steady(), delay_ms=lambda tick: 10**6 if tick >= 30 else 0)
    first = modes(ticks).index(State.HOLD)
    assert (first - 30) * TICK_MS <= 200
    assert robot.damped_at == -1
    after = np.stack([t.action_sent for t in ticks[first:]])
    assert np.abs(np.diff(after, axis=0)).max() <= HOLD_RATE + 1e-9
    np.testing.assert_allclose(after[-1], 0.0, atol=1e-9)
    assert ticks[-1].base is not None
    assert ticks[-1].base[2] > 0.7  # it stands


def frozen(
    begin: int, ticks: int, what: str
) -> Callable[[int, RobotObservation, SimRobot], RobotObservation]:
    """The readings of tick ``begin`` are repeated for ``ticks`` more."""
    kept: list[RobotObservation] = []

    def tamper(tick: int, sensed: RobotObservation, robot: SimRobot) -> RobotObservation:
        if tick == begin:
            kept.append(sensed)
        if not begin < tick <= begin + ticks:
            return sensed
        if what == "picture":
            return RobotObservation(kept[0].depth, sensed.state)
        return RobotObservation(sensed.depth, kept[0].state)

    return tamper


@pytest.mark.parametrize(
    ("what", "repeats", "worst"),
    [
        ("state", 1, State.RUN),  # 40 ms
        ("state", 3, State.HOLD),  # 120 ms, at a limit of 100
        ("state", 7, State.DAMP),  # 280 ms, at a limit of 200
        ("picture", 1, State.RUN),
        ("picture", 4, State.RUN),  # 160 ms, at a limit of 200
        ("picture", 8, State.HOLD),
    ],
)
def test_frozen_readings(sim: SimRobot, what: str, repeats: int, worst: State) -> None:
    ticks, robot = play(sim, Steady(), frozen(20, repeats, what))
    seen = set(modes(ticks))
    assert worst in seen
    if worst is State.DAMP:
        assert (robot.damped_at - 20) * TICK_MS <= 200 + TICK_MS
        assert ticks[-1].mode == State.DAMP
    else:
        assert State.DAMP not in seen
        assert ticks[-1].mode == State.RUN  # it recovers
    if worst is State.RUN:
        assert seen == {State.RUN}
    assert_gentle(ticks)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, -1e30])
def test_plans_that_are_not_finite_are_never_sent(sim: SimRobot, value: float) -> None:
    rng = np.random.default_rng(1)
    bad = rng.random(200) < 0.3
    ticks, robot = play(sim, Steady(broken=lambda k: value if bad[k] else None))
    assert_gentle(ticks)
    assert robot.damped_at == -1


def test_only_nan_plans_hold_the_robot(sim: SimRobot) -> None:
    ticks, _ = play(sim, Steady(broken=lambda k: np.nan))
    assert ticks[-1].mode == State.HOLD
    assert_gentle(ticks)


def test_a_robot_that_is_pushed_over_is_damped_within_60_ms_of_tilting(sim: SimRobot) -> None:
    tilts: list[float] = []

    def push(tick: int, sensed: RobotObservation, robot: SimRobot) -> RobotObservation:
        body = robot.env.instances[0].robot
        if tick == 20:
            body.data.qvel[:3] += (0.0, 3.0, 0.0)
            body.data.qvel[3:6] += (-4.0, 0.0, 0.0)
        tilts.append(body.tilt)
        return sensed

    ticks, robot = play(sim, Steady(0.0), push)
    fallen = next(k for k, tilt in enumerate(tilts) if tilt > 1.0)
    assert (robot.damped_at - fallen) * TICK_MS <= 60
    assert modes(ticks)[robot.damped_at :] == [State.DAMP] * (len(ticks) - robot.damped_at)


def test_a_damped_robot_sinks_and_the_next_episode_is_normal(
    sim: SimRobot,
) -> None:
    ticks, robot = play(
        sim, Steady(0.0), operator=lambda tick: OperatorRequest.ESTOP if tick == 10 else None
    )
    assert robot.damped_at == 10
    assert ticks[-1].base is not None
    assert ticks[-1].base[2] < 0.6
    ticks, _ = play(sim, Steady(0.0))
    assert set(modes(ticks)) == {State.RUN}
    assert ticks[-1].base is not None
    assert ticks[-1].base[2] > 0.7


def test_the_operator_holds_and_resumes(sim: SimRobot) -> None:
    script = {20: OperatorRequest.HOLD, 40: OperatorRequest.RUN}
    ticks, _ = play(sim, Steady(), operator=script.get)
    assert modes(ticks)[19] == State.RUN
    assert modes(ticks)[20] == State.HOLD
    assert modes(ticks)[39] == State.HOLD
    assert ticks[-1].mode == State.RUN
