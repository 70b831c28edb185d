"""Bounds of numeric options, declared with the default and checked before any work starts.

    @dataclass(frozen=True)
    class OptimizerConfig:
        lr: float = bounded(1e-3, above=0)

`egovcp.cli` checks parsed options, and ``--help`` shows the bounds. A config that is also created
elsewhere calls `check_bounds` in ``__post_init__``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

from egovcp.errors import UsageError
from egovcp.hardware import available_cores

MAX_PER_CORE: Final = 8
"""Maximum number of threads or processes per processor core."""

_KEY: Final = "bounds"
_FINITE: Final = "a finite number"
_SHOWN_LENGTH: Final = 200
_LARGE: Final = 10**100


@dataclass(frozen=True)
class Bounds:
    """An interval, closed at ``least`` and ``most``, open at ``above`` and ``below``."""

    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None
    longest: int | None = None
    """Longest list."""
    per_core: int | None = None
    """Largest number per processor core of this machine, see `check_cores`."""

    def contains(self, value: float) -> bool:
        """Whether a number is within the bounds."""
        return (
            _is_finite(value)
            and (self.least is None or value >= self.least)
            and (self.most is None or value <= self.most)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def __str__(self) -> str:
        """Text for messages, to follow "expected"."""
        words = {
            "at least": self.least,
            "more than": self.above,
            "at most": self.most,
            "less than": self.below,
        }
        said = [f"{word} {_exact(value)}" for word, value in words.items() if value is not None]
        if self.per_core is not None:
            said.append(f"at most {self.per_core} per processor core")
        return " and ".join(said) or _FINITE


def _exact(value: float) -> str:
    """1048576, not 1.04858e+06."""
    return str(int(value)) if value == int(value) else f"{value:g}"


_ANY: Final = Bounds()


def bounded[T](default: T, **limits: Any) -> T:
    """A dataclass field whose value, or each number in it if it is a collection, must lie within
    `Bounds(**limits)`. None is always valid."""
    metadata = {_KEY: Bounds(**limits)}
    if isinstance(default, dict):
        return field(default_factory=partial(copy, default), metadata=metadata)
    return field(default=default, metadata=metadata)


def bounds_of(option: dataclasses.Field[Any]) -> Bounds | None:
    """The declared bounds of a field, if any."""
    found: Bounds | None = option.metadata.get(_KEY)
    return found


class OutOfBounds(UsageError):
    """The value of an option is out of bounds."""

    def __init__(self, option: str, value: object, expected: str) -> None:
        super().__init__(f"{option}={as_flag_value(value)}: expected {expected}")
        self._args = option, value, expected

    def with_prefix(self, prefix: str) -> OutOfBounds:
        """The same error with a prefix before the name of the option."""
        option, value, expected = self._args
        return OutOfBounds(f"{prefix}{option}", value, expected)


def leaf_options(
    config: Any, prefix: str = ""
) -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """(name with ``prefix``, field, value) of every option of a dataclass and nested ones."""
    for option in dataclasses.fields(config):
        name, value = f"{prefix}{option.name}", getattr(config, option.name)
        if dataclasses.is_dataclass(value):
            yield from leaf_options(value, f"{name}.")
        else:
            yield name, option, value


def check_bounds(config: Any, prefix: str = "") -> None:
    """Raise `OutOfBounds` unless all numbers in a dataclass and nested ones are finite and within
    their bounds."""
    for name, option, value in leaf_options(config, prefix):
        bounds = bounds_of(option) or _ANY
        if bounds.longest is not None and len(value) > bounds.longest:
            raise OutOfBounds(name, f"a list of {len(value)}", f"at most {bounds.longest} numbers")
        for number in _numbers(value):
            if not bounds.contains(number):
                expected = str(bounds) if _is_finite(number) else _FINITE
                raise OutOfBounds(name, value, expected)
        if isinstance(value, tuple | list):
            for index, inner in enumerate(value):
                if dataclasses.is_dataclass(inner):
                    check_bounds(inner, f"{name}[{index}].")


def check_ranges(where: str, config: object) -> None:
    """Raise `UsageError` for a (low, high) pair in ``config`` with low > high; a field may also be
    a pair of pairs. The message names the option ``where.FIELD``."""
    for name, value in vars(config).items():
        for pair in (value, *value) if isinstance(value, tuple) else ():
            match pair:
                case (int() | float() as low, int() | float() as high) if low > high:
                    raise UsageError(
                        f"expected low <= high, found {low} > {high} in {where}.{name}"
                    )


def check_cores(config: Any, prefix: str = "") -> None:
    """Raise `OutOfBounds` for more threads or processes than this machine's cores allow.

    Not part of `check_bounds`, because a config may describe work on another machine.
    """
    cores = available_cores()
    for name, option, value in leaf_options(config, prefix):
        bounds = bounds_of(option)
        most = bounds.per_core if bounds is not None else None
        if most is not None and value > most * cores:
            expected = f"at most {most * cores}, {most} for each of {cores} processor cores"
            raise OutOfBounds(name, value, expected)


def _is_finite(number: float) -> bool:
    try:
        return math.isfinite(number)
    except OverflowError:  # an integer beyond float64
        return False


def _numbers(value: object) -> Iterator[float]:
    """All numbers in a value, except those in dataclasses."""
    match value:
        case bool() | str():
            return
        case int() | float():
            yield value
        case Mapping():
            for inner in value.values():
                yield from _numbers(inner)
        case tuple() | list():
            for inner in value:
                yield from _numbers(inner)


def as_flag_value(value: object) -> str:
    """A value in command-line syntax, truncated if it is long."""
    text = ""
    for part in _yaml(value):  # stop early: YAML aliases can make the value cyclic
        text += part
        if len(text) > _SHOWN_LENGTH:
            return f"{text[:_SHOWN_LENGTH]}..."
    return text


def _yaml(value: object) -> Iterator[str]:
    match value:
        case None | bool():
            yield {None: "null", True: "true", False: "false"}[value]
        case int():
            # hex: CPython refuses to format integers of more than 4300 digits
            yield f"{value:d}" if abs(value) < _LARGE else f"{value:#x}"
        case Mapping():
            yield "{"
            for index, (key, inner) in enumerate(value.items()):
                yield f"{', ' if index else ''}{key}: "
                yield from _yaml(inner)
            yield "}"
        case tuple() | list():
            yield "["
            for index, inner in enumerate(value):
                yield ", " if index else ""
                yield from _yaml(inner)
            yield "]"
        case _:
            yield str(value)
