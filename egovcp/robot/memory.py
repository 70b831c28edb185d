"""Memories of controllers: dataclasses of arrays with one row per robot, nested or not."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray


def replace_rows(memory: Any, fresh: Any, rows: NDArray[np.intp]) -> None:
    """Overwrite ``rows`` of ``memory``, in place, with all rows of ``fresh``."""
    for entry in fields(memory):
        old, new = getattr(memory, entry.name), getattr(fresh, entry.name)
        if isinstance(old, np.ndarray):
            old[rows] = new
        else:
            replace_rows(old, new, rows)
