"""The robot's remote control as operator."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp_deploy.live.operators import RemoteOperator
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest
from egovcp_deploy.robots.wire import FULL_STICK, RemoteControl


def pressed(*buttons: str) -> bytes:
    return RemoteControl(pressed=frozenset(buttons)).to_bytes()


@pytest.mark.parametrize(
    ("button", "request_"),
    [
        ("Y", OperatorRequest.STAND),
        ("A", OperatorRequest.ARM),
        ("start", OperatorRequest.RUN),
        ("B", OperatorRequest.HOLD),
    ],
)
def test_a_button_gives_one_request_when_it_goes_down(
    button: str, request_: OperatorRequest
) -> None:
    remote = RemoteOperator()
    assert remote.commands(pressed(button)) == [OperatorCommand(request_)]
    assert remote.commands(pressed(button)) == []
    assert remote.commands(pressed()) == []
    assert remote.commands(pressed(button)) == [OperatorCommand(request_)]


def test_l1_and_b_together_are_the_emergency_stop_while_held() -> None:
    remote = RemoteOperator()
    assert remote.commands(pressed("L1")) == []
    for _ in range(2):
        assert remote.commands(pressed("L1", "B")) == [OperatorCommand(OperatorRequest.ESTOP)]
    assert remote.commands(pressed("L1")) == []


def test_sticks_are_velocities_and_unused_buttons_are_ignored() -> None:
    remote = RemoteOperator()
    assert remote.commands(pressed("up", "F1")) == []
    (command,) = remote.commands(RemoteControl.from_velocity(np.array(FULL_STICK)).to_bytes())
    assert command.velocity == pytest.approx(FULL_STICK)


def test_an_invalid_message_gives_no_command() -> None:
    assert RemoteOperator().commands(b"") == []
