"""Who says when to stand, run and stop, and where to go: a script, the keys, or a gamepad."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from typing import Final, Protocol

from egovcp.errors import UsageError
from egovcp.terminal import echo
from egovcp_deploy.live.gamepad import GamepadOptions, gamepad
from egovcp_deploy.live.link import Order
from egovcp_deploy.pilot.states import Request, State

OPERATORS: Final = ("auto", "keyboard", "gamepad")
EASE_S: Final = 2.0  # from HOLD until the hands have come to rest
_REPEAT_NS: Final = 100_000_000
_ASK_AGAIN_NS: Final = 500_000_000  # a request that was refused; more often only fills the log
_S: Final = 1_000_000_000


class Operator(Protocol):
    """Asked often; answers with what is new."""

    def orders(self, now_ns: int, mode: str) -> list[Order]:
        """What is wanted now that the robot's state machine is in ``mode``."""
        ...


class Auto:
    """Stands up, arms, runs, and after a time holds and ends: for simulation and scripts.

    Args:
        velocity: to walk with while running; vx, vy (m/s), yaw rate (rad/s).
        duration_s: how long to run; 0: until interrupted.
    """

    def __init__(self, velocity: tuple[float, float, float], duration_s: float) -> None:
        self._velocity = velocity
        self._duration_ns = round(duration_s * _S)
        self._next_ns = 0
        self._ran_ns: int | None = None
        self._held_ns: int | None = None

    def orders(self, now_ns: int, mode: str) -> list[Order]:
        """The next step, repeated until it is taken."""
        if now_ns < self._next_ns:
            return []
        order = self._next(now_ns, mode)
        self._next_ns = now_ns + (_ASK_AGAIN_NS if order.request else _REPEAT_NS)
        return [order]

    def _next(self, now_ns: int, mode: str) -> Order:
        if self._held_ns is not None:
            return Order(Request.HOLD, quit=now_ns - self._held_ns > EASE_S * _S)
        if mode == State.RUN:
            self._ran_ns = now_ns if self._ran_ns is None else self._ran_ns
        if self._ran_ns is not None:
            if self._duration_ns and now_ns - self._ran_ns > self._duration_ns:
                self._held_ns = now_ns
                return Order(Request.HOLD)
            return Order(velocity=self._velocity)
        steps = {State.INIT: Request.STAND, State.STAND: Request.ARM, State.ARMED: Request.RUN}
        return Order(steps.get(State(mode)) if mode else None)


_KEYS: Final = {
    "s": Order(Request.STAND),
    "a": Order(Request.ARM),
    "r": Order(Request.RUN),
    "h": Order(Request.HOLD),
    " ": Order(Request.ESTOP),
    "q": Order(quit=True),
}
_STEERING: Final = {
    "i": (0.1, 0.0, 0.0),
    "k": (-0.1, 0.0, 0.0),
    "j": (0.0, 0.05, 0.0),
    "l": (0.0, -0.05, 0.0),
    "u": (0.0, 0.0, 0.1),
    "o": (0.0, 0.0, -0.1),
}
KEYBOARD_HELP: Final = (
    "keys: s stand, a arm, r run, h hold, SPACE emergency stop, q damp and quit; "
    "i/k faster/slower, j/l left/right, u/o turn, x stop walking"
)


class Keyboard:
    """Keys of the terminal. Walking goes on only while this process lives."""

    def __init__(self) -> None:
        self._velocity = (0.0, 0.0, 0.0)
        self._next_ns = 0

    def orders(self, now_ns: int, mode: str) -> list[Order]:
        """One order per key that was pressed, and the velocity ten times a second."""
        orders = [order for key in _pressed() if (order := self._order(key)) is not None]
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + _REPEAT_NS
            orders.append(Order(velocity=self._velocity))
        return orders

    def _order(self, key: str) -> Order | None:
        if key == "x":
            self._velocity = (0.0, 0.0, 0.0)
        if key in _STEERING:
            vx, vy, turn = (
                round(v + d, 3) for v, d in zip(self._velocity, _STEERING[key], strict=True)
            )
            self._velocity = (vx, vy, turn)
        return _KEYS.get(key)


def _pressed() -> Iterator[str]:
    """Keys that wait in the terminal."""
    while select.select([sys.stdin], [], [], 0.0)[0]:
        key = os.read(sys.stdin.fileno(), 1).decode(errors="replace")
        if not key:
            return
        yield key


@contextlib.contextmanager
def operator(
    kind: str,
    velocity: tuple[float, float, float],
    duration_s: float,
    pad: GamepadOptions | None = None,
) -> Iterator[Operator]:
    """The operator of ``kind``; the terminal is as before afterwards.

    Raises:
        UsageError: there is no terminal to read keys from.
        EnvironmentFailure: there is no gamepad.
    """
    if kind == "auto":
        yield Auto(velocity, duration_s)
    elif kind == "gamepad":
        with gamepad(pad or GamepadOptions()) as at_the_pad:
            yield at_the_pad
    else:
        with _keyboard() as at_the_keys:
            yield at_the_keys


@contextlib.contextmanager
def _keyboard() -> Iterator[Keyboard]:
    if not sys.stdin.isatty():
        raise UsageError(
            "--operator.type=keyboard needs a terminal, but the input is none; "
            "run it in one, or choose --operator.type=auto"
        )
    before = termios.tcgetattr(sys.stdin)
    echo(KEYBOARD_HELP)
    try:
        tty.setcbreak(sys.stdin)
        yield Keyboard()
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
