"""The lock-step loop aligns observation, action and outcome, and logs what was sent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import CameraView
from egovcp.plan import PolicyStep
from egovcp.robot_spec import G1
from egovcp.spec import ACTION_BOX, ACTION_DIM, STATE_DIM, STATE_SLICES
from egovcp_deploy.pilot.pilot import REJECTED
from egovcp_deploy.pilot.planner import LOGGED_CANDIDATES, InlinePlanner, PlannerRunner
from egovcp_deploy.robots.base import ActionResult, RobotObservation
from egovcp_deploy.rollouts import RolloutSummary, run_rollout
from tests.support.sinks import MemorySink


class PlainPolicy:
    """Plans the given actions; records its observations and the sent actions."""

    def __init__(self, actions: list[float]) -> None:
        self.actions = actions
        self.seen: list[int] = []
        self.sent: list[NDArray[np.floating]] = []
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1
        self.seen.clear()
        self.sent.clear()

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        assert depth.shape == (1, 48, 64)
        assert state.shape == (1, STATE_DIM)
        self.seen.append(int(depth[0, 0, 0]))
        value = self.actions[len(self.seen) - 1]
        plan = np.full((1, 4, ACTION_DIM), value, np.float32)
        candidates = np.repeat(plan[:, None], 64, axis=1)
        values = np.arange(64, 0, -1, dtype=np.float32)[None]
        one = np.ones(1, np.float32)
        return PolicyStep(plan[:, 0], plan, 0.5 * one, 0.1 * one, candidates, values, 3)

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        self.act(depth, state)

    def advance(self, sent: NDArray[np.floating]) -> None:
        self.sent.append(sent.copy())


class FakePolicy(PlainPolicy):
    """The same with a world model: it imagines what it saw last."""

    def reconstruct(self) -> NDArray[np.float32]:
        return np.full((1, 48, 64), float(self.seen[-1]), np.float32)

    def imagine(self, plan: NDArray[np.floating], horizon: int) -> NDArray[np.float32]:
        return np.full((1, horizon, 48, 64), float(self.seen[-1]), np.float32)


class FakeRobot:
    """Its image counts the ticks; it halves every action, so that sent and planned ones differ."""

    spec = G1
    controller_id = "fake"
    camera = CameraView()

    def __init__(self, limit: int = 5) -> None:
        self.limit = limit
        self.count = 0
        self.damped = False

    def start(self, episode: int) -> None:
        self.count = 0

    def observe(self) -> RobotObservation:
        picture = np.full((48, 64), 1000 + self.count, np.uint16)
        state = np.zeros(STATE_DIM, np.float32)
        state[STATE_SLICES["projected_gravity"].stop - 1] = -1.0
        state[STATE_SLICES["joint_velocity"]] = self.count  # no reading is like the one before
        return RobotObservation(picture, state)

    def act(self, action: NDArray[np.float64]) -> ActionResult:
        assert np.isfinite(action).all()
        self.count += 1
        return ActionResult(
            sent=action / 2,
            reward=float(self.count),
            truncated=self.count >= self.limit,
            success=self.count == self.limit,
        )

    def damp(self) -> None:
        self.damped = True

    def close(self) -> None:
        pass


def play(
    policy: PlainPolicy, robot: FakeRobot, sink: MemorySink, imagine: int = 16
) -> RolloutSummary:
    return run_rollout(InlinePlanner(PlannerRunner(policy, imagine)), robot, sink)


def test_a_tick_holds_observation_action_and_outcome() -> None:
    policy, robot, memory = FakePolicy([0.1, 0.2, 0.3, 0.2, 0.1]), FakeRobot(), MemorySink()
    summary = play(policy, robot, memory, imagine=3)
    assert [tick.index for tick in memory.ticks] == [0, 1, 2, 3, 4]
    assert [tick.time_ns for tick in memory.ticks] == [40_000_000 * k for k in range(5)]
    assert [int(tick.depth[0, 0]) for tick in memory.ticks] == [1000, 1001, 1002, 1003, 1004]
    assert [tick.reward for tick in memory.ticks] == [1, 2, 3, 4, 5]
    for tick, planned in zip(memory.ticks, policy.actions, strict=True):
        np.testing.assert_allclose(tick.action_planned, planned, rtol=1e-6)
        np.testing.assert_allclose(tick.action_sent, planned / 2, rtol=1e-6)
        assert tick.depth_reconstructed is not None
        assert tick.depth_imagined is not None
        assert tick.depth_reconstructed[0, 0] == tick.depth[0, 0]
        assert tick.depth_imagined.shape == (3, 48, 64)
        assert tick.depth_imagined[0, 0, 0] == tick.depth[0, 0]
    assert (summary.steps, summary.reward, summary.success) == (5, 15.0, True)
    assert len(summary.plan_ms) == 5


def test_the_recurrence_advances_with_the_sent_action() -> None:
    policy, memory = FakePolicy([0.3] * 5), MemorySink()
    play(policy, FakeRobot(), memory)
    assert len(policy.sent) == 4  # the last action has no observation after it
    for sent, tick in zip(policy.sent, memory.ticks, strict=False):
        np.testing.assert_array_equal(sent[0], tick.action_sent)


def test_actions_pass_the_safety_filter_before_the_robot() -> None:
    policy, memory = FakePolicy([5.0, np.nan, 5.0, 5.0, 5.0]), MemorySink()
    summary = play(policy, FakeRobot(), memory)
    sent = [float(tick.action_sent[0]) * 2 for tick in memory.ticks]
    np.testing.assert_allclose(sent, [0.32, 0.64, 0.96, 1.0, 1.0])  # the plan before goes on
    assert [REJECTED in tick.events for tick in memory.ticks] == [False, True, False, False, False]
    assert summary.rejected == 1


def test_every_rollout_starts_from_the_initial_state() -> None:
    policy, robot = FakePolicy([0.5] * 5), FakeRobot()
    actions = []
    for episode in range(2):
        robot.start(episode)
        memory = MemorySink()
        play(policy, robot, memory)
        actions.append([tick.action_sent.tolist() for tick in memory.ticks])
        assert memory.ticks[0].time_ns == 0
    assert actions[0] == actions[1]
    assert policy.resets == 2


def test_without_a_world_model_nothing_is_decoded() -> None:
    memory = MemorySink()
    play(PlainPolicy([0.1] * 5), FakeRobot(), memory, imagine=3)
    assert len(memory.ticks) == 5
    for tick in memory.ticks:
        assert tick.depth_reconstructed is None
        assert tick.depth_imagined is None
        assert tick.plan is not None


def test_the_best_candidates_are_logged_as_hand_paths() -> None:
    memory = MemorySink()
    play(FakePolicy([0.0] * 5), FakeRobot(), memory, imagine=0)
    candidates = memory.ticks[0].candidates
    assert candidates is not None
    assert candidates.hands_b.shape == (LOGGED_CANDIDATES, 4, 2, 3)
    assert candidates.values[0] == 64
    expected = np.reshape(ACTION_BOX.neutral[:6], (2, 3))
    np.testing.assert_allclose(candidates.hands_b[0, 0], expected)
    assert memory.ticks[0].depth_imagined is None
