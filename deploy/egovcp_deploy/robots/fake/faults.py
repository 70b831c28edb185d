"""What can be made to go wrong with the fake robot, and the words that do it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

from egovcp.errors import UsageError, suggest

_PUSH: Final = (-2.5, 1.0)  # m/s: nothing stands that


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
    push: tuple[float, float] | None = None
    """Change of the base's velocity, m/s, world x and y; happens once."""
    release: bool = False
    """The crane lets go, once."""
    die: bool = False
    """The fake ends at once, without a word on the wire."""

    @property
    def active(self) -> list[str]:
        """Names of those that are on."""
        return [f.name for f in fields(self) if getattr(self, f.name) not in (None, False, 0.0)]

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
        elif word in ("drop", "mode"):
            self._set_number(word, rest)
        elif word in _SWITCHES:
            setattr(self, word, rest != ["off"])
        else:
            raise UsageError(f"unknown {word!r}{suggest(word, WORDS)}")
        return f"faults: {', '.join(self.active) or 'none'}"

    def _set_number(self, word: str, rest: list[str]) -> None:
        try:
            number = float(rest[0])
        except (IndexError, ValueError) as error:
            raise UsageError(f"{word} needs a number, such as {word} 0.5") from error
        if word == "drop":
            self.drop = min(max(number, 0.0), 1.0)
        else:
            self.mode = int(number)


def _pair(words: list[str]) -> tuple[float, float]:
    try:
        x, y = map(float, words)
    except ValueError as error:
        raise UsageError("push takes two velocities in m/s, such as push 0.5 0") from error
    return x, y


_SWITCHES: Final = tuple(f.name for f in fields(Faults) if f.type == "bool")
#: All that `Faults.obey` knows.
WORDS: Final = (*_SWITCHES, "push", "drop", "mode", "heal")
