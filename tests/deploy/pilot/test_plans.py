"""What a pilot does with plans that arrive, and how long it waits for one that does not."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp.plan import PolicyStep
from egovcp.spec import ACTION_DIM, PLANNER_HZ, STATE_DIM
from egovcp_deploy.pilot.pilot import OUTDATED, REJECTED, UNREQUESTED, Pilot
from egovcp_deploy.pilot.planner import ObservationMessage, PlanMessage
from egovcp_deploy.pilot.states import Facts, State

TICK_NS = 10**9 // PLANNER_HZ
DEPTH, STATE = np.zeros((48, 64), np.uint16), np.zeros(STATE_DIM, np.float32)


class ScriptedPlanner:
    """Returns the plans in ``replies``, once."""

    alive = True
    receives = True

    def __init__(self) -> None:
        self.replies: list[PlanMessage] = []
        self.events: list[str] = []

    def submit(self, observation: ObservationMessage) -> bool:
        self.events += observation.events if self.receives else ()
        return self.receives

    def poll(self, now_ns: int) -> list[PlanMessage]:
        replies, self.replies = self.replies, []
        return replies


def plan(tick: int, value: float = 0.1) -> PlanMessage:
    actions = np.full((1, 4, ACTION_DIM), value)
    return PlanMessage(tick, PolicyStep(actions[:, 0], actions), plan_ms=1.0)


def started() -> tuple[Pilot, ScriptedPlanner]:
    planner = ScriptedPlanner()
    pilot = Pilot(planner, state=State.ARMED)
    pilot.send_observation(0, DEPTH, STATE)
    return pilot, planner


def test_plans_that_are_not_used_are_logged_with_the_reason() -> None:
    pilot, planner = started()
    for tick, reply, reason in (
        (0, plan(0), ()),
        (1, plan(0), (OUTDATED,)),
        (1, plan(1, np.nan), (REJECTED,)),
        (1, plan(2), (UNREQUESTED,)),
    ):
        if tick > pilot.tick:
            pilot.next_action()
            pilot.send_observation(tick * TICK_NS, DEPTH, STATE)
        planner.replies = [reply]
        pilot.receive_plans(tick * TICK_NS)
        assert pilot.take_events() == reason


def test_a_planner_is_silent_since_the_first_observation_without_a_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pilot, _ = started()
    silence = []

    def update(facts: Facts, request: object) -> tuple[str, ...]:
        silence.append(facts.planner_silence_s)
        return ()

    monkeypatch.setattr(pilot.supervisor, "update", update)
    for tick in range(1, 101):
        pilot.next_action()
        pilot.send_observation(tick * TICK_NS, DEPTH, STATE)
        pilot.update_state(Facts(tick * TICK_NS))
    np.testing.assert_allclose(silence, np.arange(1, 101) / PLANNER_HZ)


def test_events_are_kept_until_an_observation_is_sent() -> None:
    pilot, planner = started()
    planner.receives = False
    pilot.send_observation(TICK_NS, DEPTH, STATE, ("run -> damp: emergency stop",))
    pilot.add_events(["later"])
    planner.receives = True
    pilot.send_observation(2 * TICK_NS, DEPTH, STATE, pilot.take_events())
    assert planner.events == ["run -> damp: emergency stop", "later"]
