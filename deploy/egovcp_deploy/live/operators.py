"""Operators: the robot's remote control, the keys of a terminal, or a script. They request state
changes and the base velocity."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import numpy as np

from egovcp.errors import UsageError
from egovcp.rate import NS_PER_S, RateLimiter
from egovcp.terminal import echo
from egovcp_deploy.live.control import VELOCITY_HIGH, VELOCITY_LOW
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.wire import FULL_STICK, RemoteControl

if TYPE_CHECKING:
    from egovcp_deploy.config import OperatorOptions

EASE_S: Final = 2.0  # from HOLD to the end of a run; the hands ease to neutral in up to 1 s
_VELOCITY_PERIOD_S: Final = 0.1
_REQUEST_PERIOD_S: Final = 0.5  # of a refused request; a shorter one only fills the log


class TimedOperator:
    """Leaves all requests to the robot's remote control. It holds ``duration_s`` (0: never) after
    RUN began or the planner failed, and ends the run `EASE_S` later."""

    def __init__(self, duration_s: float = 0.0) -> None:
        self._duration_ns = round(duration_s * NS_PER_S)
        self._next_ns = 0
        self._begin_ns: int | None = None
        self._hold_ns: int | None = None

    def commands(self, now_ns: int, mode: str, failed: bool = False) -> list[OperatorCommand]:
        """The next step, repeated until it is done; ``mode`` is the robot's `State`, empty:
        unknown; ``failed``: whether the planner has failed."""
        if now_ns < self._next_ns:
            return []
        if self._begin_ns is None and (failed or mode == State.RUN):
            self._begin_ns = now_ns
        command = self._end(now_ns) or self._drive(mode)
        period = _REQUEST_PERIOD_S if command.request else _VELOCITY_PERIOD_S
        self._next_ns = now_ns + round(period * NS_PER_S)
        return [] if command == OperatorCommand() else [command]

    def _end(self, now_ns: int) -> OperatorCommand | None:
        """The command that ends the run, when its time is over."""
        if self._hold_ns is None and self._begin_ns is not None and self._duration_ns:
            over = now_ns - self._begin_ns > self._duration_ns
            self._hold_ns = now_ns if over else None
        if self._hold_ns is None:
            return None
        eased = now_ns - self._hold_ns > EASE_S * NS_PER_S
        return OperatorCommand(OperatorRequest.HOLD, quit=eased)

    def _drive(self, mode: str) -> OperatorCommand:
        """The command of a run whose time is not over."""
        return OperatorCommand()


class AutomaticOperator(TimedOperator):
    """Stands up, arms, and runs with ``velocity`` (vx, vy in m/s, yaw rate in rad/s). For
    simulation and scripts."""

    def __init__(
        self, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), duration_s: float = 0.0
    ) -> None:
        super().__init__(duration_s)
        self._velocity = velocity

    def _drive(self, mode: str) -> OperatorCommand:
        if self._begin_ns is not None:
            return OperatorCommand(velocity=self._velocity)
        requests = {
            State.INIT: OperatorRequest.STAND,
            State.STAND: OperatorRequest.ARM,
            State.ARMED: OperatorRequest.RUN,
        }
        return OperatorCommand(requests.get(State(mode)) if mode else None)


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


#: What a terminal sends for a key with Alt, an arrow or a function key. It ends before space, h and
#: q, so that no stop is lost. Its later parts, if they arrive alone, end with a capital: no key.
_ESCAPE_SEQUENCE: Final = re.compile(r"\x1b+(\[+|O)?[\d;]*[^ hq]?")


class KeyboardOperator:
    """Keys of the terminal. The robot stops walking when this process ends."""

    def __init__(self) -> None:
        self._velocity = (0.0, 0.0, 0.0)
        self._limiter = RateLimiter(_VELOCITY_PERIOD_S)

    def commands(self, now_ns: int, mode: str, failed: bool = False) -> list[OperatorCommand]:
        """One command per key, and the velocity ten times a second."""
        commands, typed = [], b""
        while select.select([sys.stdin], [], [], 0.0)[0]:
            if not (new := os.read(sys.stdin.fileno(), 4096)):
                break
            typed += new
        for key in _ESCAPE_SEQUENCE.sub("", typed.decode(errors="replace")):
            if key in _KEYS:
                commands.append(_KEYS[key])
            elif key == "x":
                self._velocity = (0.0, 0.0, 0.0)
            elif key in _VELOCITY_STEPS:
                wanted = np.round(np.add(self._velocity, _VELOCITY_STEPS[key]), 3)
                vx, vy, yaw_rate = np.clip(wanted, VELOCITY_LOW, VELOCITY_HIGH).tolist()
                self._velocity = (vx, vy, yaw_rate)
        if self._limiter.ready(now_ns):
            commands.append(OperatorCommand(velocity=self._velocity))
        return commands


# --- the robot's remote control --------------------------------------------------------------
REMOTE_HELP: Final = (
    "remote control: Y stands the robot up, A arms it, start runs the planner, B holds, L1 + B "
    "damps at once; to start it from here instead: --operator.type=keyboard, or for "
    "egovcp-fake-g1 --operator.type=auto"
)
_DEAD_BAND: Final = 0.05 * np.array(FULL_STICK)  # of the sticks, which rest near 0
_ESTOP: Final = frozenset({"L1", "B"})
_BUTTONS: Final = {
    "Y": OperatorRequest.STAND,
    "A": OperatorRequest.ARM,
    "start": OperatorRequest.RUN,
    "B": OperatorRequest.HOLD,
}


class RemoteControlInput:
    """Sticks of the remote control, with one zero when they come to rest, and its buttons: Y stands
    up, A arms, start runs, B holds, each when it goes down after the first message; L1 and B
    together are the emergency stop, for as long as both are held."""

    def __init__(self) -> None:
        self._before: frozenset[str] | None = None  # pressed buttons of the last message
        self._moving = False

    def commands(self, raw: bytes) -> list[OperatorCommand]:
        """New commands, given the newest message of the remote control (`LowState.remote`)."""
        remote = RemoteControl.parse(raw)
        if remote is None:
            return []
        new = frozenset() if self._before is None else remote.pressed - self._before
        self._before = remote.pressed
        velocity = np.where(np.abs(remote.velocity) < _DEAD_BAND, 0.0, remote.velocity)
        vx, vy, yaw_rate = velocity.tolist()
        before, self._moving = self._moving, any((vx, vy, yaw_rate))
        commands = list[OperatorCommand]()
        if self._moving or before:
            commands.append(OperatorCommand(velocity=(vx, vy, yaw_rate)))
        if remote.pressed >= _ESTOP:
            return [*commands, OperatorCommand(OperatorRequest.ESTOP)]
        return commands + [
            OperatorCommand(_BUTTONS[name]) for name in sorted(new & _BUTTONS.keys())
        ]


type Operator = TimedOperator | KeyboardOperator


@contextmanager
def open_operator(options: OperatorOptions) -> Iterator[Operator]:
    """The operator of ``options.type``; raises `UsageError` without a terminal to read keys from.
    The terminal is restored afterwards."""
    if options.type == "auto":
        yield AutomaticOperator(options.velocity, options.duration)
        return
    if options.type == "remote":
        echo(REMOTE_HELP)
        yield TimedOperator(options.duration)
        return
    if not sys.stdin.isatty():
        raise UsageError(
            "--operator.type=keyboard needs a terminal, but stdin is not a terminal; "
            "run it in one, or use the robot's remote control (--operator.type=remote)"
        )
    before = termios.tcgetattr(sys.stdin)
    echo(_KEYBOARD_HELP)
    try:
        tty.setcbreak(sys.stdin)
        yield KeyboardOperator()
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
