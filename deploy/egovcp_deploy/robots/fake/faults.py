"""What can be made to go wrong with the fake robot, and the words that do it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

from egovcp.errors import UsageError, suggest
from egovcp.spec import JOINT_NAMES

_PUSH: Final = (-2.5, 1.0)  # m/s: nothing stands that
_WEAKEST: Final = JOINT_NAMES.index("left_ankle_roll_joint")  # overheats first on real robots
_HOT: Final = 125.0  # deg C


@dataclass
class Faults:
    """All off. Set from outside at any time."""

    freeze_state: bool = False
    """The same state again and again, as from a driver that hangs."""
    mute_state: bool = False
    """No states."""
    garble_state: bool = False
    """Every second state is torn."""
    freeze_camera: bool = False
    """The same picture again and again."""
    mute_camera: bool = False
    """No pictures."""
    drop: float = 0.0
    """Share of states and pictures that are lost."""
    deaf: bool = False
    """Commands are not heard."""
    announce: bool = False
    """States tell of one more program that sends commands."""
    intruder: bool = False
    """Another program holds every joint where it is, and nothing tells of it."""
    mode: int | None = None
    """The robot reports another mode machine."""
    hot_motor: tuple[int, float] | None = None
    """A joint's motor reports this temperature, deg C (of its winding, where it reports two)."""
    dropped_motor: int | None = None
    """A joint's motor no longer obeys: no torque. Without detailed states nothing tells of it."""
    no_temperature: bool = False
    """States carry no temperatures, as from older firmware."""
    gyroscope: float = 0.0
    """The gyroscope's x axis reports this rate, rad/s, whatever the robot does."""
    joint_speed: float = 0.0
    """The left knee reports this speed, rad/s, whatever it does."""
    flood: int = 0
    """Messages of 2 kB of garbage on the state port, for each state."""
    push: tuple[float, float] | None = None
    """Change of the base's velocity, m/s, world x and y; happens once."""
    release: bool = False
    """The crane lets go, once."""
    die: bool = False
    """The fake ends at once, without a word on the wire."""

    @property
    def active(self) -> list[str]:
        """Names of those that are on."""
        return [f.name for f in fields(self) if getattr(self, f.name) != f.default]

    def obey(self, line: str) -> str:
        """Do what a line of the console says; return what to answer.

        Raises:
            UsageError: it says nothing that is known.
        """
        word, *rest = line.split() or ["release"]
        if word == "heal":
            self.__init__()  # type: ignore[misc]
        elif word == "push":
            self.push = _pair(rest) if rest else _PUSH
        elif word in ("hot_motor", "dropped_motor"):
            self._set_motor(word, rest)
        elif word in _NUMBERS:
            self._set_number(word, rest)
        elif word in _SWITCHES:
            setattr(self, word, rest != ["off"])
        else:
            raise UsageError(f"unknown {word!r}{suggest(word, WORDS)}")
        return f"faults: {', '.join(self.active) or 'none'}"

    def _set_number(self, word: str, rest: list[str]) -> None:
        kind, low, high, example = _NUMBERS[word]
        if rest == ["off"]:
            setattr(self, word, getattr(Faults(), word))
            return
        try:
            number = float(rest[0])
            setattr(self, word, kind(min(max(number, low), high)))
        except (IndexError, ValueError) as error:
            raise UsageError(f"{word} needs a number, such as {word} {example}") from error

    def _set_motor(self, word: str, rest: list[str]) -> None:
        if rest == ["off"]:
            setattr(self, word, None)
            return
        joint = _joint(rest[0]) if rest else _WEAKEST
        if word == "dropped_motor":
            self.dropped_motor = joint
            return
        try:
            self.hot_motor = joint, float(rest[1]) if len(rest) > 1 else _HOT
        except ValueError as error:
            raise UsageError(
                "hot_motor takes a joint and deg C, such as hot_motor left_knee_joint 125"
            ) from error


def _joint(name: str) -> int:
    """Index of a joint, whose ending ``_joint`` may be left out."""
    names = {joint.removesuffix("_joint"): i for i, joint in enumerate(JOINT_NAMES)}
    found = names.get(name.removesuffix("_joint"))
    if found is None:
        raise UsageError(f"unknown joint {name!r}{suggest(name, names)}")
    return found


def _pair(words: list[str]) -> tuple[float, float]:
    try:
        x, y = map(float, words)
    except ValueError as error:
        raise UsageError("push takes two velocities in m/s, such as push 0.5 0") from error
    return x, y


#: Word -> type, least, greatest and an example of its number.
_NUMBERS: Final[dict[str, tuple[type[int] | type[float], float, float, str]]] = {
    "drop": (float, 0.0, 1.0, "0.5"),
    "mode": (int, 0, 255, "6"),
    "gyroscope": (float, -1e6, 1e6, "150"),
    "joint_speed": (float, -1e6, 1e6, "190"),
    "flood": (int, 0, 1000, "20"),
}
_SWITCHES: Final = tuple(f.name for f in fields(Faults) if f.type == "bool")
#: All that `Faults.obey` knows.
WORDS: Final = (*_SWITCHES, *_NUMBERS, "hot_motor", "dropped_motor", "push", "heal")
