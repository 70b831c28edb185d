"""Operators: the robot's remote control, the keyboard, and those that end a run by themselves."""

from __future__ import annotations

import os
import pty
import select
import sys

import numpy as np
import pytest

from egovcp_deploy.config import OperatorOptions
from egovcp_deploy.live.control import VELOCITY_HIGH, VELOCITY_LOW
from egovcp_deploy.live.operators import (
    AutomaticOperator,
    KeyboardOperator,
    RemoteControlInput,
    TimedOperator,
    open_operator,
)
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State
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
    remote = RemoteControlInput()
    assert remote.commands(pressed(button)) == [], "held since before the program"
    assert remote.commands(pressed()) == []
    assert remote.commands(pressed(button)) == [OperatorCommand(request_)]
    assert remote.commands(pressed(button)) == []
    assert remote.commands(pressed()) == []
    assert remote.commands(pressed(button)) == [OperatorCommand(request_)]


def test_l1_and_b_together_are_the_emergency_stop_while_held() -> None:
    remote = RemoteControlInput()
    estop = [OperatorCommand(OperatorRequest.ESTOP)]
    assert RemoteControlInput().commands(pressed("L1", "B")) == estop, "also in the first message"
    assert remote.commands(pressed("L1")) == []
    for _ in range(2):
        assert remote.commands(pressed("L1", "B")) == estop
    assert remote.commands(pressed("L1")) == []


def test_sticks_are_velocities_and_unused_buttons_are_ignored() -> None:
    remote = RemoteControlInput()
    assert remote.commands(pressed("up", "F1")) == []
    (command,) = remote.commands(RemoteControl.from_velocity(np.array(FULL_STICK)).to_bytes())
    assert command.velocity == pytest.approx(FULL_STICK)


def test_an_invalid_message_gives_no_command() -> None:
    assert RemoteControlInput().commands(b"") == []


def sticks(*velocity: float) -> bytes:
    return RemoteControl.from_velocity(np.array(velocity)).to_bytes()


def test_released_sticks_give_one_zero_velocity() -> None:
    remote = RemoteControlInput()
    remote.commands(sticks(0.3, 0.0, 0.0))
    assert remote.commands(sticks(0.0, 0.0, 0.0)) == [OperatorCommand(velocity=(0.0, 0.0, 0.0))]
    assert remote.commands(sticks(0.0, 0.0, 0.0)) == []


def test_a_stick_near_its_rest_position_gives_no_velocity() -> None:
    remote, drift = RemoteControlInput(), 0.04 * np.array(FULL_STICK)
    assert remote.commands(sticks(*drift)) == []
    (command,) = remote.commands(sticks(0.3, *drift[1:]))
    assert command.velocity == pytest.approx((0.3, 0.0, 0.0))


def test_the_velocity_of_the_keyboard_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    with open(reader) as keys:
        monkeypatch.setattr(sys, "stdin", keys)
        keyboard = KeyboardOperator()
        os.write(writer, b"i" * 30 + b"l" * 30)
        (command,) = keyboard.commands(0, State.RUN)
        assert command.velocity == (VELOCITY_HIGH[0], VELOCITY_LOW[1], 0.0)
        os.write(writer, b"k")
        (command,) = keyboard.commands(10**9, State.RUN)
        assert command.velocity == pytest.approx((VELOCITY_HIGH[0] - 0.1, VELOCITY_LOW[1], 0.0))
        os.close(writer)


@pytest.mark.parametrize(
    ("typed", "requests"),
    [
        (b"sAHa", [OperatorRequest.STAND, OperatorRequest.ARM]),
        (b"\x1bs\x1bA", []),  # with Alt
        (b"[AOROQ[15~", []),  # the later part of a sequence
        (b"\x1bh", [OperatorRequest.HOLD]),
        (b"\x1b[A\x1b\x1b[A\x1b[[A\x1bOA\x1bOR\x1b[1;2S\x1b[15~", []),  # arrows, function keys
        (b"\x1b[Ah", [OperatorRequest.HOLD]),
        (b"\x1b \x1b[ ", [OperatorRequest.ESTOP] * 2),
    ],
)
def test_capitals_and_escape_sequences_are_no_keys(
    typed: bytes, requests: list[OperatorRequest], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, terminal = pty.openpty()
    with open(terminal) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        with open_operator(OperatorOptions("keyboard")) as operator:
            os.write(keys, typed)
            assert select.select([stdin], [], [], 10.0)[0]
            *commands, last = operator.commands(0, State.STAND)
    os.close(keys)
    assert [command.request for command in commands] == requests
    assert last.velocity == (0.0, 0.0, 0.0)


def test_the_default_operator_leaves_all_requests_to_the_remote_control(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with open_operator(OperatorOptions()) as operator:
        commands = [operator.commands(k * 10**9, mode) for k, mode in enumerate(["", *State])]
    assert commands == [[]] * len(commands)
    out = capsys.readouterr().out
    assert "Y stands the robot up" in out
    assert "--operator.type=keyboard" in out


@pytest.mark.parametrize("operator_type", [TimedOperator, AutomaticOperator])
@pytest.mark.parametrize(("mode", "failed"), [(State.RUN, False), (State.ARMED, True)])
def test_the_duration_counts_from_run_or_from_a_failure(
    operator_type: type[TimedOperator], mode: State, failed: bool
) -> None:
    operator = operator_type(duration_s=3.0)
    sent: list[tuple[float, OperatorCommand]] = []
    for k in range(100):
        now_s = k / 10
        started = now_s >= 1.0
        commands = operator.commands(
            round(now_s * 1e9), mode if started else State.ARMED, failed and started
        )
        sent += [(now_s, command) for command in commands]
    holds = [now_s for now_s, command in sent if command.request is OperatorRequest.HOLD]
    quits = [now_s for now_s, command in sent if command.quit]
    assert holds[0] == pytest.approx(4.1)
    assert quits[0] == pytest.approx(6.6)
    later = {command.request for now_s, command in sent if now_s > 1.4}
    assert later <= {None, OperatorRequest.HOLD}
