"""Faults of the fake G1, and the console commands that set them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final

from egovcp.errors import UsageError, suggest
from egovcp.spec import JOINT_NAMES

_PUSH: Final = (-2.5, 1.0)  # m/s: no controller withstands it
_DEFAULT_JOINT: Final = JOINT_NAMES.index("left_ankle_roll_joint")
_HOT: Final = 125.0  # deg C
_VALUES: Final = {"push": 2, "hot_motor": 2, "dropped_motor": 1, "drop": 1, "mode": 1}  # at most


@dataclass
class InjectedFaults:
    """Faults of the fake G1, all off by default. May be changed at any time."""

    freeze_state: bool = False  # repeat the last state, like a hung driver
    stop_state: bool = False  # send no states
    truncate_state: bool = False  # cut every second state in half
    freeze_camera: bool = False  # repeat the last image
    stop_camera: bool = False  # send no images
    drop: float = 0.0  # share of states and images that are lost
    ignore_commands: bool = False  # receive commands without executing them
    other_publisher: bool = False  # another program holds every joint where it is
    mode: int | None = None  # report this value of Unitree's `mode_machine` field
    hot_motor: tuple[int, float] | None = None
    """Index of a joint, and the temperature of its motor's winding, deg C. Detailed states report
    it; others report its mean with the casing's 35 deg C."""
    dropped_motor: int | None = None  # joint without torque; only detailed states report it
    push: tuple[float, ...] | None = None  # change of the base's velocity, m/s, world x, y; once
    release: bool = False  # the gantry releases the robot, once
    crash: bool = False  # the process ends at once, without sending anything

    @property
    def active(self) -> list[str]:
        """Names of the faults that are on."""
        return [f.name for f in fields(self) if getattr(self, f.name) != f.default]

    def apply(self, line: str) -> str:
        """Execute a line of the console and return the answer; an empty line is ``release``. Raises
        `UsageError` if it is not a known command."""
        word, *rest = line.split() or ["release"]
        if word not in FAULT_COMMANDS:
            raise UsageError(f"unknown {word!r}{suggest(word, FAULT_COMMANDS)}")
        if len(rest) > (most := _VALUES.get(word, 0)) and rest != ["off"]:
            values = f"at most {most} values" if most else "nothing"
            raise UsageError(f"found {' '.join(rest)!r} after {word}, expected {values}, or off")
        if word == "clear":
            self._reset(*(f.name for f in fields(self)))
        elif rest == ["off"]:
            self._reset(word)
        elif word == "push":
            self.push = tuple(_numbers(rest, "push 0.5 0", 2)) if rest else _PUSH
        elif word == "dropped_motor":
            self.dropped_motor = _joint(rest)
        elif word == "hot_motor":
            degrees = _numbers(rest[1:], "hot_motor left_knee 125", 1) if rest[1:] else [_HOT]
            self.hot_motor = _joint(rest), degrees[0]
        elif word == "drop":
            self.drop = _numbers(rest, "drop 0.5", 1, high=1.0)[0]
        elif word == "mode":
            (value,) = _numbers(rest, "mode 6", 1, high=255.0)
            if not value.is_integer():
                raise UsageError(f"mode {value:g}: expected a whole number, such as mode 6")
            self.mode = int(value)
        else:
            setattr(self, word, True)
        return f"faults: {', '.join(self.active) or 'none'}"

    def _reset(self, *names: str) -> None:
        for name in names:
            setattr(self, name, getattr(InjectedFaults, name))


def _numbers(
    words: list[str], example: str, count: int, *, high: float | None = None
) -> list[float]:
    """Parse ``count`` finite numbers, from 0 to ``high`` if that is given."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    valid = all(math.isfinite(n) and (high is None or 0.0 <= n <= high) for n in numbers)
    if len(numbers) == count and valid:
        return numbers
    limits = "" if high is None else f" from 0 to {high:g}"
    raise UsageError(f"expected {count} finite number(s){limits}, such as {example}")


def _joint(rest: list[str]) -> int:
    """Index of a joint; the ending ``_joint`` may be omitted."""
    if not rest:
        return _DEFAULT_JOINT
    names = {joint.removesuffix("_joint"): i for i, joint in enumerate(JOINT_NAMES)}
    found = names.get(rest[0].removesuffix("_joint"))
    if found is None:
        raise UsageError(f"unknown joint {rest[0]!r}{suggest(rest[0], names)}")
    return found


FAULT_COMMANDS: Final = (*(f.name for f in fields(InjectedFaults)), "clear")
