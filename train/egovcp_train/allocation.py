"""Freed memory is kept for the next step, not handed back to the system and cleared again."""

from __future__ import annotations

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of mallopt(3)
LARGEST = 32 << 20  # bytes; what is larger is data, not a step's intermediate results


def keep_freed_memory() -> bool:
    """Tell the C library so, for the whole process; False where it knows no such setting.

    A gradient step on the CPU allocates and frees some hundred tensors of a few MB. By default
    each goes back to the system, which clears its pages anew: thousands of page faults per step.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not glibc
        return False
    return bool(mallopt(MMAP_THRESHOLD, LARGEST) and mallopt(TRIM_THRESHOLD, 2**31 - 1))
