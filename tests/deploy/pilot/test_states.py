"""The state machine goes where it should, when it should, and never out of DAMP."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from egovcp.log.tick import MODES
from egovcp_deploy.pilot.states import Facts, Limits, OperatorRequest, State, Supervisor

TICK_NS = 20_000_000
WELL = Facts(time_ns=0)


def test_the_states_are_those_of_the_log() -> None:
    assert tuple(State) == MODES


def at(state: State) -> Supervisor:
    return Supervisor(state=state)


def feed(machine: Supervisor, facts: Facts, seconds: float, start_ns: int = 0) -> int:
    """The same facts for ``seconds`` at 50 Hz; the time afterwards."""
    ticks = round(seconds * 50)
    for k in range(ticks):
        machine.update(replace(facts, time_ns=start_ns + k * TICK_NS))
    return start_ns + ticks * TICK_NS


def test_requests_lead_from_init_to_run() -> None:
    machine = Supervisor()
    assert machine.update(WELL) == ()
    assert machine.state is State.INIT
    assert machine.update(WELL, OperatorRequest.STAND) == (
        "init -> stand: requested by the operator",
    )
    (refused,) = machine.update(WELL, OperatorRequest.ARM)
    assert refused == "arm refused: still standing up, 3.0 s to go"
    now = feed(machine, WELL, 3.0)
    machine.update(replace(WELL, time_ns=now), OperatorRequest.ARM)
    assert machine.state is State.ARMED
    machine.update(replace(WELL, time_ns=now), OperatorRequest.RUN)
    assert machine.state is State.RUN


@pytest.mark.parametrize("request_", [OperatorRequest.ARM, OperatorRequest.RUN])
def test_no_state_can_be_skipped(request_: OperatorRequest) -> None:
    machine = Supervisor()
    (refused,) = machine.update(WELL, request_)
    assert refused.startswith(f"{request_} refused: the robot is in init")
    assert machine.state is State.INIT


def test_stand_is_refused_before_the_first_reading() -> None:
    machine = Supervisor()
    (refused,) = machine.update(replace(WELL, state_age_s=math.inf), OperatorRequest.STAND)
    assert "proprioception" in refused
    assert machine.state is State.INIT


def test_a_refusal_prevents_arming() -> None:
    machine = at(State.STAND)
    now = feed(machine, WELL, 4.0)
    (refused,) = machine.update(
        replace(WELL, time_ns=now, refusal="another publisher is alive"), OperatorRequest.ARM
    )
    assert refused == "arm refused: another publisher is alive"


def test_run_is_refused_without_a_depth_image() -> None:
    machine = at(State.ARMED)
    machine.update(replace(WELL, image_age_s=math.inf), OperatorRequest.RUN)
    assert machine.state is State.ARMED


DAMPS = [
    {"state_age_s": 0.201},
    {"tilt": 1.01},
    {"tilt": math.nan},
    {"height": 0.39},
    {"height": math.nan},
    {"controller_ok": False},
]


@pytest.mark.parametrize("state", [State.ARMED, State.RUN, State.HOLD])
@pytest.mark.parametrize("fault", DAMPS, ids=str)
def test_critical_faults_damp_at_once_and_for_good(state: State, fault: dict[str, float]) -> None:
    machine = at(state)
    machine.update(replace(WELL, **fault))
    assert machine.state is State.DAMP
    reason = machine.reason
    now = feed(machine, WELL, 5.0)
    for request in OperatorRequest:
        machine.update(replace(WELL, time_ns=now), request)
    assert machine.state is State.DAMP
    assert machine.reason == reason


@pytest.mark.parametrize("state", list(State))
def test_the_emergency_stop_works_in_every_state(state: State) -> None:
    machine = at(state)
    machine.update(WELL, OperatorRequest.ESTOP)
    assert machine.state is State.DAMP


HOLDS = [
    {"state_age_s": 0.101},
    {"image_age_s": 0.201},
    {"planner_silence_s": 0.141},
    {"misses": 6},
    {"planner_alive": False},
]


@pytest.mark.parametrize("fault", HOLDS, ids=str)
def test_other_faults_hold_and_recover(fault: dict[str, float]) -> None:
    machine = at(State.RUN)
    machine.update(replace(WELL, **fault))
    assert machine.state is State.HOLD
    now = feed(machine, WELL, 0.98, TICK_NS)
    assert machine.state is State.HOLD
    feed(machine, WELL, 0.2, now)
    assert machine.state is State.RUN


ALMOST = [
    {"state_age_s": 0.05},
    {"image_age_s": 0.19},
    {"planner_silence_s": 0.13},
    {"misses": 5},
    {"tilt": 0.9},
    {"height": 0.5},
]


@pytest.mark.parametrize("fault", ALMOST, ids=str)
def test_values_within_the_limits_do_not_hold(fault: dict[str, float]) -> None:
    machine = at(State.RUN)
    feed(machine, replace(WELL, **fault), 2.0)
    assert machine.state is State.RUN


def test_a_fault_that_comes_and_goes_does_not_flicker() -> None:
    machine, changes, now = at(State.RUN), 0, 0
    for _ in range(20):
        before = machine.state
        now = feed(machine, replace(WELL, misses=6), 0.1, now)
        changes += machine.state is not before
        now = feed(machine, WELL, 0.5, now)
    assert changes == 1
    assert machine.state is State.HOLD


def test_a_requested_hold_ends_only_on_request() -> None:
    machine = at(State.RUN)
    machine.update(WELL, OperatorRequest.HOLD)
    now = feed(machine, WELL, 5.0)
    assert machine.state is State.HOLD
    machine.update(replace(WELL, time_ns=now), OperatorRequest.RUN)
    feed(machine, WELL, 1.1, now)
    assert machine.state is State.RUN


def test_a_hold_request_during_a_fault_is_logged_and_outlasts_it() -> None:
    machine = at(State.RUN)
    fault = replace(WELL, image_age_s=0.5)
    assert machine.update(fault) == ("run -> hold: no new depth image for 500 ms",)
    assert machine.update(fault, OperatorRequest.HOLD) == ("hold requested by the operator",)
    assert machine.update(fault, OperatorRequest.HOLD) == (), "Ctrl-C repeats it"
    feed(machine, WELL, 5.0)
    assert (machine.state, machine.reason) == (State.HOLD, "no new depth image for 500 ms")


def test_a_run_request_in_hold_is_answered() -> None:
    machine = at(State.RUN)
    machine.update(WELL, OperatorRequest.HOLD)
    pending = "run requested; RUN follows 1 s without a fault"
    fault = replace(WELL, image_age_s=0.5)
    (answer,) = machine.update(fault, OperatorRequest.RUN)
    assert answer == f"{pending}; now: no new depth image for 500 ms"
    assert machine.update(WELL, OperatorRequest.RUN) == (pending,)
    feed(machine, WELL, 1.1)
    assert machine.state is State.RUN


def test_a_request_after_damp_is_refused() -> None:
    machine = at(State.RUN)
    machine.update(WELL, OperatorRequest.ESTOP)
    refused = "run refused: the motors stay damped; start the program again"
    assert machine.update(WELL, OperatorRequest.RUN) == (refused,)
    assert machine.update(WELL, OperatorRequest.HOLD) == ()


@pytest.mark.parametrize("state", [State.RUN, State.HOLD])
@pytest.mark.parametrize("name", ["stand", "arm", "run"])
def test_requests_that_the_state_does_not_allow_are_refused(state: State, name: str) -> None:
    machine = at(state)
    lines = machine.update(WELL, OperatorRequest(name))
    assert machine.state is state
    if (state, name) != (State.HOLD, "run"):
        assert lines == (f"{name} refused: the robot is in {state}",)


def test_a_low_robot_may_stand_up_but_not_be_armed() -> None:
    machine = at(State.STAND)
    low = replace(WELL, height=0.3)
    now = feed(machine, low, 4.0)
    assert machine.state is State.STAND
    (refused,) = machine.update(replace(low, time_ns=now), OperatorRequest.ARM)
    assert "0.30 m" in refused


def test_damp_is_latched_and_run_needs_a_request_for_random_facts() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        machine, now, requested, damped = Supervisor(Limits(stand_s=0.1)), 0, False, False
        for _ in range(100):
            now += TICK_NS
            facts = Facts(
                now,
                state_age_s=float(rng.choice([0.0, 0.15, 0.25], p=[0.9, 0.07, 0.03])),
                image_age_s=float(rng.choice([0.0, 0.3], p=[0.9, 0.1])),
                misses=int(rng.choice([0, 7], p=[0.9, 0.1])),
                tilt=float(rng.choice([0.0, 1.2], p=[0.99, 0.01])),
            )
            request = rng.choice([None, *OperatorRequest], p=[0.7, 0.1, 0.1, 0.06, 0.03, 0.01])
            machine.update(facts, request)
            requested |= request is OperatorRequest.RUN
            assert not (damped and machine.state is not State.DAMP)
            damped = machine.state is State.DAMP
            assert requested or machine.state is not State.RUN
