"""Reports survive the link between the processes, with and without motors."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from egovcp.log.tick import MotorReadings
from egovcp_deploy.live.link import decode_observation, encode_observation
from egovcp_deploy.pilot.planner import ObservationMessage

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
