"""Which episodes of a dataset are asked for: ``[0, 5, 7]``, ``0:1334``, ``[0:100, 250]``."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError

_PART = re.compile(r"(\d+)|(\d*):(\d*)", re.ASCII)


def select_episodes(text: str, count: int) -> NDArray[np.int64]:
    """The numbers that ``text`` names, in ascending order, each once; all of them if it is empty.

    A lone number needs its brackets: YAML reads the range ``1:30`` as the number 90 where it is not
    quoted, and that must not pass for an episode.

    Args:
        text: numbers and ranges ``first:end`` without the end, separated by commas; either end of
            a range may be left out.
        count: episodes of the dataset.

    Raises:
        UsageError: it is not of this form, names nothing, or an episode that is not there.
    """
    if not text.strip():
        return np.arange(count)
    wanted: NDArray[np.int64] = np.unique(
        np.concatenate([_part(part, text, count) for part in _parts(text)])
    )
    if len(wanted) == 0:
        raise UsageError(f"--dataset.episodes={text} names no episode; there are {count}")
    if wanted[-1] >= count:
        raise UsageError(
            f"--dataset.episodes={text} names episode {wanted[-1]}, but the dataset has {count} "
            f"episodes, 0 to {count - 1}"
        )
    return wanted


def _parts(text: str) -> list[str]:
    inner = text.strip()
    if inner.startswith("[") and inner.endswith("]"):
        inner = inner[1:-1]
    elif inner.isdigit():
        raise UsageError(
            f"--dataset.episodes={text}: for a single episode write [{inner}], for the first ones "
            f"0:{inner}; in YAML, quote a range: '0:{inner}'"
        )
    return [part.strip() for part in inner.split(",")]


def _part(part: str, text: str, count: int) -> NDArray[np.int64]:
    found = _PART.fullmatch(part)
    if found is None:
        raise UsageError(
            f"--dataset.episodes={text}: {part!r} is no episode; expected numbers, [0, 5, 7], a "
            "range without its end, 0:1334, or both, [0:100, 250]"
        )
    number, first, end = found.groups()
    if number:
        return np.array([int(number)])
    return np.arange(int(first or 0), int(end or count))
