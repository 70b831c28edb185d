"""The link between the processes: encoding, a full queue, and addresses that cannot be used."""

from __future__ import annotations

import gc
import warnings
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.log.tick import MotorReadings
from egovcp.plan import PolicyStep
from egovcp.spec import ACTION_DIM
from egovcp_deploy.live.link import (
    Link,
    RemotePlanner,
    decode_observation,
    decode_plan,
    encode_observation,
    encode_plan,
)
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.planner import ObservationMessage, PlanMessage

COUNT = np.arange(29)
BARE = MotorReadings(torque=COUNT / 3.0)
ONE_TEMPERATURE = MotorReadings(torque=COUNT / 3.0, temperature=30.0 + COUNT[:, None])
FULL = MotorReadings(
    torque=COUNT / 3.0,
    temperature=np.stack([30.0 + COUNT, np.where(COUNT == 2, np.nan, 40.0)], axis=1),
    faults=np.where(COUNT == 3, 0x80000000, 0),
    enabled=COUNT != 3,
)


@pytest.mark.parametrize("motors", [None, BARE, ONE_TEMPERATURE, FULL])
def test_motors_and_link_are_decoded_as_encoded(motors: MotorReadings | None) -> None:
    depth, state = np.full((48, 64), 1500, np.uint16), np.arange(74, dtype=np.float32)
    link = {"state_rate_hz": 200.0, "image_age_ms": 31.5}
    observation = ObservationMessage(
        3, 10**12, depth, state, np.ones(7), False, "run", ("a", "b"), motors, link
    )
    back = decode_observation(encode_observation(observation))
    assert back is not None
    assert (back.link, back.events, back.mode) == (link, ("a", "b"), "run")
    if motors is None:
        assert back.motors is None
        return
    assert back.motors is not None
    for field in fields(MotorReadings):
        found, sent = getattr(back.motors, field.name), getattr(motors, field.name)
        assert (found is None) == (sent is None), field.name
        if sent is not None:
            np.testing.assert_array_equal(found, sent)
            assert found.dtype == sent.dtype


def test_a_damaged_observation_is_none() -> None:
    depth, state = np.zeros((48, 64), np.uint16), np.zeros(74, np.float32)
    parts = encode_observation(
        ObservationMessage(3, 1, depth, state, np.ones(7), False, "run", (), FULL, {})
    )
    assert decode_observation(parts[:-1]) is None
    assert decode_observation([*parts[:-1], parts[-1][:-8]]) is None
    assert decode_observation([parts[0].replace(b"torque", b"torpor"), *parts[1:]]) is None


def test_events_of_a_plan_are_not_sent_because_the_planner_logs_them() -> None:
    actions = np.zeros((1, 4, ACTION_DIM), np.float32)
    step = PolicyStep(actions[:, 0], actions)
    back = decode_plan(encode_plan(PlanMessage(3, step, 1.5, events=("skipped",))))
    assert back is not None
    assert (back.tick, back.plan_ms, back.events) == (3, 1.5, ())


def test_events_that_a_full_queue_rejects_arrive_later(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/link"
    depth, state = np.zeros((48, 64), np.uint16), np.zeros(74, np.float32)
    with (
        closing(Link(address, serve=True)) as ours,
        closing(Link(address, serve=False)) as theirs,
    ):
        while not theirs.send([b"connected"]):
            pass
        while theirs.send([bytes(10_000)]):
            pass
        pilot = Pilot(RemotePlanner(theirs))
        pilot.send_observation(0, depth, state, ("run -> damp: emergency stop",))
        early = [*ours.receive(1.0), *ours.receive(), *ours.receive()]
        assert early
        received = [decode_observation(parts) for parts in early]
        for time_ns in range(100):
            pilot.next_action()
            pilot.send_observation(time_ns, depth, state, pilot.take_events())
            received += [decode_observation(parts) for parts in ours.receive(0.1)]
        events = [event for message in received if message for event in message.events]
    assert events == ["run -> damp: emergency stop"]


def test_a_socket_path_that_is_too_long_names_tmpdir(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    gc.collect()  # what earlier tests left
    with warnings.catch_warnings(record=True) as unclosed:
        warnings.simplefilter("always")  # a socket that is not closed warns when it is collected
        with pytest.raises(EnvironmentFailure, match="TMPDIR"):
            Link(f"ipc://{folder}/link", serve=True)
        gc.collect()
    assert not unclosed
