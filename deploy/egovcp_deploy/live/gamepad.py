"""A gamepad at this machine as the operator, through Linux's joystick interface.

The kernel hands out events of 8 bytes: time (ms, uint32), value (int16), type and number (uint8
each); type 1 is a button, 2 an axis. Types with 0x80 tell of the state at the time of
opening, which may be wrong and is nobody's wish.
"""

from __future__ import annotations

import errno
import os
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from typing import Final

from egovcp.bounds import bounded
from egovcp.errors import EnvironmentFailure
from egovcp.terminal import echo
from egovcp_deploy.live.buttons import Buttons
from egovcp_deploy.live.link import Order
from egovcp_deploy.robots.remote_control import RemoteControl

_EVENT: Final = struct.Struct("<IhBB")
_BUTTON, _AXIS = 0x01, 0x02
_FULL: Final = 32767.0
_REST: Final = 0.1  # of the way: a stick at rest is not quite at zero
_READ_BYTES: Final = 64 * _EVENT.size
_REPEAT_NS: Final = 100_000_000
_LOOK_NS: Final = 1_000_000_000  # for a pad that is gone
GAMEPAD_HELP: Final = (
    "gamepad: Y stand, A arm, start run, B hold, LB + B emergency stop, LB + back damp and quit; "
    "left stick walks, right stick turns"
)


@dataclass(frozen=True)
class GamepadButtons:
    """The driver's number of each button."""

    A: int = bounded(0, least=0, most=255)
    """Arm."""
    B: int = bounded(1, least=0, most=255)
    """Hold."""
    Y: int = bounded(3, least=0, most=255)
    """Stand up."""
    L1: int = bounded(4, least=0, most=255)
    """Held with B: emergency stop; with select: damp and quit."""
    select: int = bounded(6, least=0, most=255)
    """With L1: damp and quit."""
    start: int = bounded(7, least=0, most=255)
    """Run."""


@dataclass(frozen=True)
class GamepadAxes:
    """The driver's number of each axis; sticks read negative to the left and forward."""

    lx: int = bounded(0, least=0, most=255)
    """Left stick, sideways: walk sideways."""
    ly: int = bounded(1, least=0, most=255)
    """Left stick: walk forward and back."""
    rx: int = bounded(3, least=0, most=255)
    """Right stick, sideways: turn."""


@dataclass(frozen=True)
class GamepadOptions:
    """Which gamepad. The numbers are those of an Xbox pad; `jstest` shows those of another."""

    path: str = "/dev/input/js0"
    """Its joystick device."""
    button: GamepadButtons = field(default_factory=GamepadButtons)
    """Its buttons."""
    axis: GamepadAxes = field(default_factory=GamepadAxes)
    """Its sticks."""


class Gamepad:
    """The operator at a gamepad. One that is unplugged orders nothing, so that the velocity it
    asked for runs out, and is looked for once a second.

    Raises:
        EnvironmentFailure: there is none, or it may not be read.
    """

    def __init__(self, options: GamepadOptions) -> None:
        self._options = options
        self._buttons = Buttons()
        self._names = {
            getattr(options.button, each.name): each.name for each in fields(GamepadButtons)
        }
        self._next_ns = self._look_ns = 0
        self._forget()
        try:
            self._file: int | None = _open(options.path)
        except OSError as error:
            raise EnvironmentFailure(
                f"no gamepad at {options.path} ({error.strerror}); expected a joystick device: "
                "plug one in (ls /dev/input/js*), be in the group input, and name it with "
                "--operator.gamepad.path, or choose --operator.type=keyboard"
            ) from error

    def _forget(self) -> None:
        self._axes: dict[int, float] = {}
        self._pressed: frozenset[str] = frozenset()

    def orders(self, now_ns: int, mode: str) -> list[Order]:
        """What was pressed since the last call, and ten times a second the velocity."""
        if self._file is None and not self._found_again(now_ns):
            return []
        orders = [order for pressed in self._events() for order in self._asked(pressed)]
        if self._file is not None and now_ns >= self._next_ns:
            self._next_ns = now_ns + _REPEAT_NS
            vx, vy, turn = self._sticks.velocity.tolist()
            orders.append(Order(velocity=(vx, vy, turn)))
        return orders

    def _asked(self, pressed: frozenset[str]) -> list[Order]:
        orders = self._buttons.orders(pressed)
        return [*orders, Order(quit=True)] if pressed >= {"L1", "select"} else orders

    @property
    def _sticks(self) -> RemoteControl:
        axis = self._options.axis
        lx, ly, rx = (self._axes.get(number, 0.0) for number in (axis.lx, axis.ly, axis.rx))
        return RemoteControl(lx=lx, ly=-ly, rx=rx)

    def _events(self) -> Iterator[frozenset[str]]:
        """The buttons that are held, after each time one was pressed or let go."""
        for value, kind, number in self._read():
            if kind == _AXIS:
                share = max(-1.0, value / _FULL)
                self._axes[number] = share if abs(share) > _REST else 0.0
            elif kind == _BUTTON and number in self._names:
                name = {self._names[number]}
                self._pressed = self._pressed | name if value else self._pressed - name
                yield self._pressed

    def _read(self) -> Iterator[tuple[int, int, int]]:
        """Value, type and number of each event that waits."""
        assert self._file is not None
        try:
            while data := os.read(self._file, _READ_BYTES):
                whole = len(data) - len(data) % _EVENT.size
                for _, value, kind, number in _EVENT.iter_unpack(data[:whole]):
                    yield value, kind, number
        except BlockingIOError:
            return
        except OSError:
            pass  # unplugged
        self._lose()

    def _lose(self) -> None:
        self.close()
        self._forget()
        with suppress(OSError):
            echo(
                f"the gamepad {self._options.path} is gone: the robot stops walking; Ctrl-C holds "
                "it, twice damps it",
                error=True,
            )

    def _found_again(self, now_ns: int) -> bool:
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + _LOOK_NS
            with suppress(OSError):
                self._file = _open(self._options.path)
        return self._file is not None

    def close(self) -> None:
        """Let go of the device; further calls do nothing."""
        file, self._file = self._file, None
        if file is not None:
            os.close(file)


def _open(path: str) -> int:
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    if stat.S_ISCHR(mode := os.fstat(file).st_mode) or stat.S_ISFIFO(mode):
        return file
    os.close(file)
    raise OSError(errno.ENOTTY, "it is no device")


@contextmanager
def gamepad(options: GamepadOptions) -> Iterator[Gamepad]:
    """The operator at the gamepad.

    Raises:
        EnvironmentFailure: there is none, or it may not be read.
    """
    pad = Gamepad(options)
    echo(GAMEPAD_HELP)
    try:
        yield pad
    finally:
        pad.close()
