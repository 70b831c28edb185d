"""A gamepad whose joystick events come from a named pipe."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from egovcp.errors import EnvironmentFailure
from egovcp_deploy.live.control import VelocityCommand
from egovcp_deploy.live.operators import Gamepad, GamepadButtons, GamepadOptions
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest
from egovcp_deploy.robots.remote_control import FULL_STICK

A, B, Y, L1, SELECT, START = 0, 1, 3, 4, 6, 7
LX, LY, RX = 0, 1, 3
S = 1_000_000_000


def button(number: int, down: bool) -> bytes:
    return struct.pack("<IhBB", 0, int(down), 1, number)


def axis(number: int, value: int, kind: int = 2) -> bytes:
    return struct.pack("<IhBB", 0, value, kind, number)


class Pad:
    """Somebody's hands, and the operator that they are."""

    def __init__(self, path: Path) -> None:
        self._path, self.now = path, S
        os.mkfifo(path)
        self._plug = os.open(path, os.O_RDWR)
        self.operator = Gamepad(GamepadOptions(str(path)))

    def do(self, *events: bytes, wait: float = 0.0) -> list[OperatorCommand]:
        os.write(self._plug, b"".join(events))
        return self.commands(wait)

    def commands(self, wait: float = 0.0) -> list[OperatorCommand]:
        self.now += round(wait * S)
        return self.operator.commands(self.now, "run")

    def unplug(self) -> None:
        os.close(self._plug)
        self._path.unlink()

    def plug_in(self) -> None:
        os.mkfifo(self._path)
        self._plug = os.open(self._path, os.O_RDWR)

    def close(self) -> None:
        self.operator.close()
        os.close(self._plug)


@pytest.fixture
def pad(tmp_path: Path) -> Iterator[Pad]:
    pad = Pad(tmp_path / "js0")
    pad.commands()  # the first velocity
    yield pad
    pad.close()


@pytest.mark.parametrize(
    ("number", "request_"),
    [
        (Y, OperatorRequest.STAND),
        (A, OperatorRequest.ARM),
        (START, OperatorRequest.RUN),
        (B, OperatorRequest.HOLD),
    ],
)
def test_a_button_gives_one_request_when_it_goes_down(
    pad: Pad, number: int, request_: OperatorRequest
) -> None:
    assert pad.do(button(number, True)) == [OperatorCommand(request_)]
    assert pad.do() == []
    assert pad.do(button(number, False)) == []
    assert pad.do(button(number, True), button(number, False)) == [OperatorCommand(request_)]


def test_l1_and_b_together_are_the_emergency_stop(pad: Pad) -> None:
    assert pad.do(button(L1, True)) == []
    assert pad.do(button(B, True)) == [OperatorCommand(OperatorRequest.ESTOP)]


def test_l1_and_select_together_quit(pad: Pad) -> None:
    assert pad.do(button(L1, True), button(SELECT, True))[-1].quit


def test_sticks_are_velocities_forward_left_and_turning_left(pad: Pad) -> None:
    (order,) = pad.do(axis(LY, -32767), axis(LX, -32767), axis(RX, -16384), wait=0.2)
    assert order.velocity == pytest.approx((FULL_STICK[0], FULL_STICK[1], 0.25), abs=1e-3)
    (order,) = pad.do(axis(LY, 32767), axis(LX, 2000), axis(RX, -32768), wait=0.2)
    assert order.velocity == pytest.approx((-FULL_STICK[0], 0.0, FULL_STICK[2]))


def test_initial_events_of_the_driver_are_ignored(pad: Pad) -> None:
    (order,) = pad.do(axis(LY, -32767, kind=0x82), button(START, True)[:6] + b"\x81\x07", wait=0.2)
    assert order.velocity == (0.0, 0.0, 0.0)


def test_unused_buttons_are_ignored_and_numbers_can_be_configured(tmp_path: Path, pad: Pad) -> None:
    assert pad.do(button(15, True), axis(17, 32767)) == []
    other = Pad(tmp_path / "js1")
    other.operator = Gamepad(
        GamepadOptions(str(tmp_path / "js1"), GamepadButtons(start=9, select=8, Y=2))
    )
    assert other.do(button(9, True))[0] == OperatorCommand(OperatorRequest.RUN)
    other.close()


def test_after_unplugging_the_velocity_times_out_and_replugging_works(
    pad: Pad, capsys: pytest.CaptureFixture[str]
) -> None:
    command = VelocityCommand()
    (order,) = pad.do(axis(LY, -32767), wait=0.2)
    assert order.velocity is not None
    command.set_target(pad.now, order.velocity)
    pad.unplug()
    assert pad.commands(0.2) == []
    assert "is gone" in capsys.readouterr().err
    for _ in range(10):
        assert pad.commands(0.2) == []
        moving = command.at(pad.now, allowed=True)
    assert not moving.any()
    pad.plug_in()
    pad.commands(1.5)
    assert pad.do(button(B, True))[0] == OperatorCommand(OperatorRequest.HOLD)


@pytest.mark.parametrize("make", [lambda path: None, lambda path: path.mkdir()])
def test_no_gamepad_is_refused(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "js0")
    with pytest.raises(EnvironmentFailure, match="no gamepad at"):
        Gamepad(GamepadOptions(str(tmp_path / "js0")))
