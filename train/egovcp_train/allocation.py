"""Freed memory is kept for the next step, not handed back to the system and cleared again."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Final

TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD = -1, -2, -3  # of mallopt(3)
LARGEST = 32 << 20  # bytes; what is larger is data, not a step's intermediate results
ROOM: Final = 512 << 20  # bytes of addresses, not of memory, more than all such results of a step
_HUGEPAGE: Final = 14  # of madvise(2)


def keep_freed_memory() -> bool:
    """Tell the C library so, for the whole process; False where it knows no such setting.

    A gradient step on the CPU allocates and frees some hundred tensors of a few MB. By default
    each goes back to the system, which clears its pages anew: thousands of page faults per step.
    Where the system can it is to back this memory with large pages: a step goes through so much
    that the processor forgets where small ones are.
    """
    try:
        libc = ctypes.CDLL(None)
        mallopt = libc.mallopt
    except (AttributeError, OSError, TypeError):  # not glibc
        return False
    kept = mallopt(MMAP_THRESHOLD, LARGEST) and mallopt(TRIM_THRESHOLD, 2**31 - 1)
    if kept and mallopt(TOP_PAD, ROOM):
        _reserve(libc)
        mallopt(TOP_PAD, 128 << 10)  # the default
    return bool(kept)


def _reserve(libc: ctypes.CDLL) -> None:
    """Let the heap grow by what it is padded with, and ask for large pages there."""
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    libc.madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    libc.free(libc.malloc(LARGEST - (1 << 20)))
    for start, end in _heap():
        libc.madvise(start, end - start, _HUGEPAGE)  # refused: small pages, as before


def _heap() -> list[tuple[int, int]]:
    """Addresses of what the C library allocates from; none where the system does not say."""
    try:
        lines = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    ranges = (line.split()[0].split("-") for line in lines if line.endswith("[heap]"))
    return [(int(start, 16), int(end, 16)) for start, end in ranges]
