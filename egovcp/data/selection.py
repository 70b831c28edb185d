"""Parses a selection of episodes: ``[0, 5, 7]``, ``0:1334``, ``[0:100, 250]``."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import as_flag_value
from egovcp.errors import UsageError

_PART = re.compile(r"(\d{1,18})|(\d{0,18}):(\d{0,18})", re.ASCII)


def select_episodes(text: str, count: int, flag: str = "--dataset.episodes") -> NDArray[np.int64]:
    """The selected episode numbers, ascending and unique; all if ``text`` is empty.

    A single number needs brackets: YAML reads an unquoted ``1:30`` as the number 90, which must not
    be taken for an episode.

    Args:
        text: numbers and ranges ``first:end`` without the end, separated by commas; either end of
            a range may be omitted. May be in brackets or parentheses.
        count: episodes of the dataset.
        flag: the option, for messages.

    Raises:
        UsageError: ``text`` is malformed, selects nothing, or an episode that does not exist.
    """
    inner = text.strip()
    if not inner:
        return np.arange(count)
    given = f"{flag}={as_flag_value(text)}"
    if inner[0] + inner[-1] in ("[]", "()"):
        inner = inner[1:-1]
    elif inner.isdigit():
        number = as_flag_value(inner)
        raise UsageError(
            f"{given}: for a single episode write [{number}], for the first ones 0:{number}; in "
            f"YAML, quote a range: '0:{number}'"
        )
    parts = [_part(part.strip(), given, count) for part in inner.split(",")]
    wanted: NDArray[np.int64] = np.unique(np.concatenate(parts))
    if len(wanted) == 0:
        raise UsageError(f"{given} selects no episode; there are {count}")
    return wanted


def _part(part: str, given: str, count: int) -> NDArray[np.int64]:
    found = _PART.fullmatch(part)
    if found is None:
        raise UsageError(
            f"{given}: {as_flag_value(part)!r} is not an episode; expected numbers, [0, 5, 7], a "
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
