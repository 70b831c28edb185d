"""Operators: a script, the keys of a terminal, or a gamepad. They request state changes and the
base velocity."""

from __future__ import annotations

import errno
import os
import select
import stat
import struct
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Final, Protocol

from egovcp.bounds import bounded
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.rate import NS_PER_S, RateLimiter
from egovcp.terminal import echo
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.remote_control import RemoteControl

if TYPE_CHECKING:
    from egovcp_deploy.config import OperatorOptions

EASE_S: Final = 2.0  # from HOLD until the hands are in the neutral pose
_VELOCITY_PERIOD_S: Final = 0.1
_REQUEST_PERIOD_S: Final = 0.5  # of a refused request; a shorter one only fills the log


class Operator(Protocol):
    """Source of operator commands, polled often."""

    def commands(self, now_ns: int, mode: str) -> list[OperatorCommand]:
        """New commands; ``mode`` is the robot's `State`, empty: unknown."""
        ...


class AutomaticOperator:
    """Stands up, arms, and runs with ``velocity`` (vx, vy in m/s, yaw rate in rad/s); after
    ``duration_s`` (0: never) it holds and ends the run. For simulation and scripts."""

    def __init__(
        self, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), duration_s: float = 0.0
    ) -> None:
        self._velocity = velocity
        self._duration_ns = round(duration_s * NS_PER_S)
        self._next_ns = 0
        self._run_ns: int | None = None
        self._hold_ns: int | None = None

    def commands(self, now_ns: int, mode: str) -> list[OperatorCommand]:
        """The next step, repeated until it is done."""
        if now_ns < self._next_ns:
            return []
        command = self._next(now_ns, mode)
        period = _REQUEST_PERIOD_S if command.request else _VELOCITY_PERIOD_S
        self._next_ns = now_ns + round(period * NS_PER_S)
        return [command]

    def _next(self, now_ns: int, mode: str) -> OperatorCommand:
        if self._hold_ns is not None:
            eased = now_ns - self._hold_ns > EASE_S * NS_PER_S
            return OperatorCommand(OperatorRequest.HOLD, quit=eased)
        if mode == State.RUN and self._run_ns is None:
            self._run_ns = now_ns
        if self._run_ns is None:
            requests = {
                State.INIT: OperatorRequest.STAND,
                State.STAND: OperatorRequest.ARM,
                State.ARMED: OperatorRequest.RUN,
            }
            return OperatorCommand(requests.get(State(mode)) if mode else None)
        if self._duration_ns and now_ns - self._run_ns > self._duration_ns:
            self._hold_ns = now_ns
            return OperatorCommand(OperatorRequest.HOLD)
        return OperatorCommand(velocity=self._velocity)


# --- keyboard --------------------------------------------------------------------------------
_KEYS: Final = {
    "s": OperatorCommand(OperatorRequest.STAND),
    "a": OperatorCommand(OperatorRequest.ARM),
    "r": OperatorCommand(OperatorRequest.RUN),
    "h": OperatorCommand(OperatorRequest.HOLD),
    " ": OperatorCommand(OperatorRequest.ESTOP),
    "q": OperatorCommand(quit=True),
}
_VELOCITY_STEPS: Final = {
    "i": (0.1, 0.0, 0.0),
    "k": (-0.1, 0.0, 0.0),
    "j": (0.0, 0.05, 0.0),
    "l": (0.0, -0.05, 0.0),
    "u": (0.0, 0.0, 0.1),
    "o": (0.0, 0.0, -0.1),
}
_KEYBOARD_HELP: Final = (
    "keys: s stand, a arm, r run, h hold, SPACE emergency stop, q damp and quit; "
    "i/k faster/slower, j/l left/right, u/o turn, x stop walking"
)


class Keyboard:
    """Keys of the terminal. The robot stops walking when this process ends."""

    def __init__(self) -> None:
        self._velocity = (0.0, 0.0, 0.0)
        self._limiter = RateLimiter(_VELOCITY_PERIOD_S)

    def commands(self, now_ns: int, mode: str) -> list[OperatorCommand]:
        """One command per key, and the velocity ten times a second."""
        commands = [_KEYS[key] for key in self._pressed() if key in _KEYS]
        if self._limiter.ready(now_ns):
            commands.append(OperatorCommand(velocity=self._velocity))
        return commands

    def _pressed(self) -> Iterator[str]:
        """Keys waiting in the terminal; those for the velocity are applied."""
        while select.select([sys.stdin], [], [], 0.0)[0]:
            key = os.read(sys.stdin.fileno(), 1).decode(errors="replace")
            if not key:
                return
            if key == "x":
                self._velocity = (0.0, 0.0, 0.0)
            if key in _VELOCITY_STEPS:
                sums = (
                    v + step for v, step in zip(self._velocity, _VELOCITY_STEPS[key], strict=True)
                )
                vx, vy, yaw_rate = (round(v, 3) for v in sums)
                self._velocity = (vx, vy, yaw_rate)
            yield key


@contextmanager
def _keyboard() -> Iterator[Keyboard]:
    if not sys.stdin.isatty():
        raise UsageError(
            "--operator.type=keyboard needs a terminal, but the input is none; "
            "run it in one, or choose --operator.type=auto"
        )
    before = termios.tcgetattr(sys.stdin)
    echo(_KEYBOARD_HELP)
    try:
        tty.setcbreak(sys.stdin)
        yield Keyboard()
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


# --- buttons of the robot's remote control and of a gamepad ----------------------------------
_ESTOP: Final = frozenset({"L1", "B"})
_BUTTONS: Final = {
    "Y": OperatorRequest.STAND,
    "A": OperatorRequest.ARM,
    "start": OperatorRequest.RUN,
    "B": OperatorRequest.HOLD,
}


class ButtonCommands:
    """Y stands up, A arms, start runs, B holds, each when it goes down; L1 and B together are the
    emergency stop, for as long as both are held."""

    def __init__(self) -> None:
        self._before: frozenset[str] = frozenset()

    def update(self, pressed: frozenset[str]) -> list[OperatorCommand]:
        """New commands, given the buttons (`remote.BUTTONS`) that are held now."""
        new, self._before = pressed - self._before, pressed
        if pressed >= _ESTOP:
            return [OperatorCommand(OperatorRequest.ESTOP)]
        return [OperatorCommand(_BUTTONS[name]) for name in sorted(new) if name in _BUTTONS]


# --- gamepad ---------------------------------------------------------------------------------
# The kernel's joystick events have 8 bytes: time (ms, uint32), value (int16), type and number
# (uint8 each). Type 1 is a button, 2 an axis. Types with bit 0x80 report the state when the device
# was opened, which may be wrong, and are ignored.
_EVENT: Final = struct.Struct("<IhBB")
_BUTTON, _AXIS = 0x01, 0x02
_FULL_SCALE: Final = 32767.0
_DEAD_ZONE: Final = 0.1  # of the full scale: a stick at rest is not exactly at zero
_READ_BYTES: Final = 64 * _EVENT.size
_RECONNECT_PERIOD_S: Final = 1.0
_GAMEPAD_HELP: Final = (
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
    """The driver's number of each axis; sticks are negative to the left and forward."""

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
    """A gamepad at this machine; raises `EnvironmentFailure` if it does not exist. After it is
    unplugged it gives no commands, so that the velocity times out; once a second it is reopened."""

    def __init__(self, options: GamepadOptions) -> None:
        self._options = options
        self._buttons = ButtonCommands()
        self._names = {
            getattr(options.button, each.name): each.name for each in fields(GamepadButtons)
        }
        self._velocity_limiter = RateLimiter(_VELOCITY_PERIOD_S)
        self._reconnect_limiter = RateLimiter(_RECONNECT_PERIOD_S)
        self._axes: dict[int, float] = {}
        self._pressed: frozenset[str] = frozenset()
        try:
            self._file: int | None = _open_device(options.path)
        except OSError as error:
            raise EnvironmentFailure(
                f"no gamepad at {options.path} ({error.strerror}); expected a joystick device: "
                "plug one in (ls /dev/input/js*), be in the group input, and name it with "
                "--operator.gamepad.path, or choose --operator.type=keyboard"
            ) from error

    def commands(self, now_ns: int, mode: str) -> list[OperatorCommand]:
        """Requests since the last call, and the velocity ten times a second."""
        if self._file is None and self._reconnect_limiter.ready(now_ns):
            with suppress(OSError):
                self._file = _open_device(self._options.path)
        if self._file is None:
            return []
        commands = []
        for pressed in self._changes(self._file):
            commands += self._buttons.update(pressed)
            if pressed >= {"L1", "select"}:
                commands.append(OperatorCommand(quit=True))
        if self._file is not None and self._velocity_limiter.ready(now_ns):
            axis = self._options.axis
            lx, ly, rx = (self._axes.get(number, 0.0) for number in (axis.lx, axis.ly, axis.rx))
            vx, vy, yaw_rate = RemoteControl(lx=lx, ly=-ly, rx=rx).velocity.tolist()
            commands.append(OperatorCommand(velocity=(vx, vy, yaw_rate)))
        return commands

    def _changes(self, file: int) -> Iterator[frozenset[str]]:
        """Apply the waiting events; yields the buttons that are held after each change."""
        for value, kind, number in self._read(file):
            if kind == _AXIS:
                share = max(-1.0, value / _FULL_SCALE)
                self._axes[number] = share if abs(share) > _DEAD_ZONE else 0.0
            elif kind == _BUTTON and number in self._names:
                name = {self._names[number]}
                self._pressed = self._pressed | name if value else self._pressed - name
                yield self._pressed

    def _read(self, file: int) -> Iterator[tuple[int, int, int]]:
        """Value, type and number of each waiting event."""
        try:
            while data := os.read(file, _READ_BYTES):
                whole = len(data) - len(data) % _EVENT.size
                for _, value, kind, number in _EVENT.iter_unpack(data[:whole]):
                    yield value, kind, number
        except BlockingIOError:
            return
        except OSError:
            pass  # unplugged
        self._disconnect()

    def _disconnect(self) -> None:
        self.close()
        self._axes, self._pressed = {}, frozenset()
        with suppress(OSError):
            echo(
                f"the gamepad {self._options.path} is gone: the robot stops walking; Ctrl-C holds "
                "it, twice damps it",
                error=True,
            )

    def close(self) -> None:
        """Close the device; further calls do nothing."""
        file, self._file = self._file, None
        if file is not None:
            os.close(file)


def _open_device(path: str) -> int:
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    if stat.S_ISCHR(mode := os.fstat(file).st_mode) or stat.S_ISFIFO(mode):
        return file
    os.close(file)
    raise OSError(errno.ENOTTY, "not a device")


def open_operator(options: OperatorOptions) -> AbstractContextManager[Operator]:
    """The operator of ``options.type``; raises `UsageError` without a terminal to read keys from,
    `EnvironmentFailure` without a gamepad. The terminal is restored afterwards."""
    if options.type == "auto":
        return nullcontext(AutomaticOperator(options.velocity, options.duration))
    if options.type == "keyboard":
        return _keyboard()
    pad = closing(Gamepad(options.gamepad))
    echo(_GAMEPAD_HELP)
    return pad
