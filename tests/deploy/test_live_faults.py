"""Faults of every kind, once, against the fake G1 over ZMQ.

``benchmarks/live_faults.py`` repeats all faults on loaded cores and checks the times.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from egovcp.log.tick import MotorReadings
from egovcp_deploy.robots.base import LowState
from egovcp_deploy.robots.wire import MalformedMessage, decode_state, encode_state
from tests.support.robots.fault_kinds import FAULTS, FaultKind, Reaction
from tests.support.robots.fault_rig import FaultRig
from tests.support.robots.fault_runs import DAMP_LIMIT_MS, run_fault

_ATTEMPTS = 3  # a busy machine also delays sensors and planner

#: States that are rejected before they are decoded completely, as "state: not JSON" is.
MALFORMED = (
    *("state: all torn", "state: empty messages", "state: another topic", "state: a JSON list"),
    *("state: nested 30000 deep", "state: position NaN", "state: position Infinity"),
    *("state: position 1e400", "state: position with 4000 digits", "state: position null"),
    *("state: position a string", "state: position true", "state: no motors"),
    *("state: 29 motor slots", "state: no IMU", "state: no mode machine"),
    *("state: remote control not base64", "state: quaternion zero"),
    "state: quaternion of length 2",
)
#: At least one fault of every source and with every reaction; the others only with ``-m slow``.
ALWAYS = (
    *("state: silent", "state: silent for 60 ms", "state: silent for 150 ms", "state: frozen"),
    *("state: 30 % lost", "state: not JSON", "gyroscope: 150 rad/s", "mode machine: 5 to 6"),
    *("joint position: jumps by 0.5 rad", "motor: winding at 125 deg C"),
    *("motor: dropped, status disconnected", "flood: the same without states"),
    *("connection: 20 kB/s", "connection: cut, port closed", "image: silent", "image: garbage"),
    *("planner: silent", "planner: plans NaN", "remote control: emergency stop"),
    *("operator: emergency stop", "operator: velocity NaN", "robot: pushed over"),
    "control process: SIGKILL",
)
BY_NAME = {kind.name: kind for kind in FAULTS}
PLAYED = [
    pytest.param(kind, id=name, marks=[] if name in ALWAYS else [pytest.mark.slow])
    for name, kind in BY_NAME.items()
]


@pytest.fixture(scope="module")
def rig() -> Iterator[FaultRig]:
    found = FaultRig()
    yield found
    found.close()


def test_there_are_at_least_60_faults() -> None:
    assert set(ALWAYS) <= BY_NAME.keys()
    assert len({kind.name for kind in FAULTS}) == len(FAULTS) >= 60


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_state_is_rejected(name: str) -> None:
    fake: Any = SimpleNamespace()
    BY_NAME[name].begin(cast(FaultRig, SimpleNamespace(fake=fake)))
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    motors = MotorReadings(np.zeros(29))
    state = LowState(0, np.full(29, 0.1), np.zeros(29), upright, np.zeros(3), 5, motors=motors)
    message = encode_state(state, np.array([0.0, 0.0, 9.81]))
    decode_state(message, 0)
    for altered in fake.alter_state(message):
        with pytest.raises(MalformedMessage):
            decode_state(altered, 0)


@pytest.mark.parametrize("kind", PLAYED)
def test_the_reaction_is_the_required_one(rig: FaultRig, kind: FaultKind) -> None:
    for _ in range(_ATTEMPTS):
        row = run_fault(rig, kind)
        assert not row.invalid  # never, however busy the machine is
        late = kind.reaction is Reaction.DAMP and (row.damped_ms or 0.0) > 2 * DAMP_LIMIT_MS
        if not row.problem and not late:
            break
    assert not row.problem
    assert not late, f"damped after {row.damped_ms:.0f} ms"
