"""The record of an episode in ``meta/collection.json``: what LeRobot has no place for."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec

_LARGEST_LIMIT: Final = 2**31 - 1
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")


def record_problems(
    records: object, lengths: NDArray[np.int64]
) -> Iterator[tuple[int | None, str]]:
    """What is wrong with the records: (the episode at fault, or None; what is wrong).

    Args:
        records: ``episodes`` of the file.
        lengths: (E,) frames of each episode.
    """
    if not isinstance(records, list):
        yield None, f"episodes is a {type(records).__name__}, expected a list"
    elif len(records) != len(lengths):
        yield None, f"records {len(records)} episodes, but meta/episodes lists {len(lengths)}"
    else:
        for index, record in enumerate(records):
            yield from ((index, problem) for problem in _problems(record, int(lengths[index])))


def _problems(record: object, length: int) -> Iterator[str]:
    if not isinstance(record, Mapping):
        yield f"its record is a {type(record).__name__}, expected an object"
        return
    yield from shape_problems(record)
    if record.get("length", length) != length:
        yield f"its record says {record['length']} frames, but meta/episodes says {length}"


def shape_problems(record: Mapping[Any, Any]) -> Iterator[str]:
    """What is wrong with one record, whatever episode it belongs to."""
    task, limit, digest = record.get("task"), record.get("time_limit"), record.get("sha256", "")
    if task not in spec.TASKS:
        yield f"its task is {task!r}, expected one of {', '.join(spec.TASKS)}"
    if not isinstance(limit, int) or isinstance(limit, bool) or not 0 < limit <= _LARGEST_LIMIT:
        yield f"its time_limit is {limit!r}, expected 1 to {_LARGEST_LIMIT} ticks"
    if not isinstance(digest, str) or (digest and not _DIGEST.fullmatch(digest)):
        yield f"its sha256 is {digest!r}, expected 64 hexadecimal digits"
    if not isinstance(record.get("metadata", {}), Mapping):
        yield "its metadata is no object"
