"""Which episodes of a dataset are asked for: ``[0, 5, 7]``, ``0:1334``, ``[0:100, 250]``."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import as_flag_value
from egovcp.errors import UsageError

_PART = re.compile(r"(\d{1,18})|(\d{0,18}):(\d{0,18})", re.ASCII)


def select_episodes(text: str, count: int, flag: str = "--dataset.episodes") -> NDArray[np.int64]:
    """The numbers that ``text`` names, in ascending order, each once; all of them if it is empty.

    A lone number needs its brackets: YAML reads the range ``1:30`` as the number 90 where it is not
    quoted, and that must not pass for an episode.

    Args:
        text: numbers and ranges ``first:end`` without the end, separated by commas; either end of
            a range may be left out. May be in brackets or parentheses.
        count: episodes of the dataset.
        flag: names the option in messages.

    Raises:
        UsageError: it is not of this form, names nothing, or an episode that is not there.
    """
    if not text.strip():
        return np.arange(count)
    given = f"{flag}={as_flag_value(text)}"
    wanted: NDArray[np.int64] = np.unique(
        np.concatenate([_part(part, given, count) for part in _parts(text, given)])
    )
    if len(wanted) == 0:
        raise UsageError(f"{given} names no episode; there are {count}")
    return wanted


def _parts(text: str, given: str) -> list[str]:
    inner = text.strip()
    if inner[0] + inner[-1] in ("[]", "()"):
        inner = inner[1:-1]
    elif inner.isdigit():
        raise UsageError(
            f"{given}: for a single episode write [{as_flag_value(inner)}], for the first ones "
            f"0:{as_flag_value(inner)}; in YAML, quote a range: '0:{as_flag_value(inner)}'"
        )
    return [part.strip() for part in inner.split(",")]


def _part(part: str, given: str, count: int) -> NDArray[np.int64]:
    found = _PART.fullmatch(part)
    if found is None:
        raise UsageError(
            f"{given}: {as_flag_value(part)!r} is no episode; expected numbers, [0, 5, 7], a "
            "range without its end, 0:1334, or both, [0:100, 250]"
        )
    number, first, end = found.groups()
    start = int(number or first or 0)
    stop = start + 1 if number else int(end or count)
    if start < stop and stop > count:
        raise UsageError(
            f"{given} names episode {stop - 1}, but the dataset has {count} episodes, "
            f"0 to {count - 1}"
        )
    return np.arange(start, stop)
