"""What the buttons of a remote control, or of a gamepad, ask for."""

from __future__ import annotations

from typing import Final

from egovcp_deploy.live.link import Order
from egovcp_deploy.pilot.states import Request

_ESTOP: Final = frozenset({"L1", "B"})
_KEYS: Final = {
    "Y": Request.STAND,
    "A": Request.ARM,
    "start": Request.RUN,
    "B": Request.HOLD,
}


class Buttons:
    """Y stands up, A arms, start runs, B holds; L1 and B together damp.

    A button asks when it goes down; the emergency stop for as long as both are held.
    """

    def __init__(self) -> None:
        self._before: frozenset[str] = frozenset()

    def orders(self, pressed: frozenset[str]) -> list[Order]:
        """What is new now that ``pressed`` (`remote.BUTTONS`) are held down."""
        new, self._before = pressed - self._before, pressed
        if pressed >= _ESTOP:
            return [Order(Request.ESTOP)]
        return [Order(_KEYS[name]) for name in sorted(new) if name in _KEYS]
