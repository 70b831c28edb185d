"""Device and precision of the arithmetic, and the memory allocator of the process."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Final

import torch

from egovcp.errors import EnvironmentFailure, UsageError

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # of mallopt(3)
_HUGEPAGE: Final = 14  # of madvise(2)
_LARGEST_BYTES: Final = 32 << 20  # of an intermediate tensor of a step
_HEAP_BYTES: Final = 512 << 20  # address space for all of them


def choose_device(name: str) -> torch.device:
    """The device that ``--device`` names.

    Raises:
        EnvironmentFailure: there is no such device here, or it cannot be used.
        UsageError: there is no such kind of device.
    """
    available = torch.cuda.is_available()
    if name == "auto":
        return torch.device("cuda" if available else "cpu")
    if name.startswith("cuda") and not available:
        raise EnvironmentFailure("--device=cuda, but torch finds no CUDA device; use --device=cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise UsageError(f"unknown --device {name!r}; expected cpu, cuda or auto") from error
    try:
        torch.ones(1, device=device).item()
    except (AssertionError, ImportError, RuntimeError) as error:  # torch lacks its backend, or else
        raise EnvironmentFailure(
            f"--device={name} cannot be used ({_reason(error)}); use --device=cpu"
        ) from error
    return device


@contextmanager
def reporting_full_memory() -> Iterator[None]:
    """Raise `EnvironmentFailure` if the memory of the device does not suffice for the block."""
    try:
        yield
    except RuntimeError as error:
        if not is_full_memory(error):
            raise
        raise EnvironmentFailure(
            f"the memory of the device does not suffice ({_reason(error)}); lower --batch_size, or "
            "end other programs that use the device"
        ) from error


def is_full_memory(error: Exception) -> bool:
    """Whether the memory of a device is exhausted; torch has no class for that of the CPU."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def choose_bf16(name: str, device: torch.device) -> bool:
    """Whether matrix products are in bfloat16, for a value of ``--mixed_precision``.

    auto: if the device computes in it; emulated bfloat16 is slower than float32.
    """
    if name != "auto":
        return name == "bf16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    has = torch.cpu.get_capabilities() if device.type == "cpu" else {}
    return bool(has.get("avx512_bf16") or has.get("amx_bf16"))


def precision(device: torch.device, bf16: bool) -> AbstractContextManager[object]:
    """Context in which matrix products are in bfloat16, if so; weights and sums are float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=bf16)


def keep_freed_memory() -> bool:
    """Make the C library reuse freed memory, in large pages; False where it is not glibc.

    A gradient step on the CPU allocates and frees hundreds of tensors of a few MB. By default each
    of them is returned to the system and costs page faults when it is allocated again.
    """
    try:
        libc = ctypes.CDLL(None)
        mallopt = libc.mallopt
    except (AttributeError, OSError, TypeError):
        return False
    kept = mallopt(_MMAP_THRESHOLD, _LARGEST_BYTES) and mallopt(_TRIM_THRESHOLD, 2**31 - 1)
    if kept and mallopt(_TOP_PAD, _HEAP_BYTES):
        _reserve(libc)
        mallopt(_TOP_PAD, 128 << 10)  # the default
    return bool(kept)


def _reserve(libc: ctypes.CDLL) -> None:
    """Grow the heap, and request large pages for it."""
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    libc.madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    libc.free(libc.malloc(_LARGEST_BYTES - (1 << 20)))
    try:
        lines = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        if line.endswith("[heap]"):
            start, end = (int(address, 16) for address in line.split()[0].split("-"))
            libc.madvise(start, end - start, _HUGEPAGE)  # if refused, the pages stay small
