"""Processor cores, free memory, and a description of the machine."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path
from typing import Final

from egovcp.errors import UsageError

_MEMINFO: Final = Path("/proc/meminfo")
_CGROUP: Final = Path("/sys/fs/cgroup")


def available_cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def require_memory(option: str, needed: int) -> None:
    """Raise `UsageError`, which names an option such as ``--num_envs=8``, unless ``needed`` bytes
    of memory are free."""
    free = available_bytes()
    if needed > free:
        raise UsageError(
            f"{option} takes at least {needed / 1e9:,.1f} GB of memory, {free / 1e9:,.1f} GB are "
            "free; lower it"
        )


def available_bytes() -> int:
    """Memory that this process can allocate within the limits of the system and its container."""
    return min(_of_the_system(), _of_the_container())


def _of_the_system() -> int:
    if _MEMINFO.exists():
        for line in _MEMINFO.read_text(encoding="ascii").splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable":
                return int(value.split()[0]) * 1024
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def _of_the_container() -> int:
    """Memory left below the limit of control group v2; `sys.maxsize` without a limit."""
    try:
        limit = (_CGROUP / "memory.max").read_text(encoding="ascii").strip()
        used = int((_CGROUP / "memory.current").read_text(encoding="ascii"))
        statistics = (_CGROUP / "memory.stat").read_text(encoding="ascii").splitlines()
        cached = next(int(n) for key, n in map(str.split, statistics) if key == "inactive_file")
        return int(limit) - used + cached  # the page cache can be freed
    except (OSError, ValueError, StopIteration):  # no group, or no limit
        return sys.maxsize


def hardware() -> dict[str, object]:
    """Flat description of the hardware for reports of timings."""
    import torch  # processes that only simulate do not import it

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    return {
        "hardware_cpu": model,
        "hardware_cores": os.cpu_count() or 1,
        "hardware_gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "torch": torch.__version__,
        "torch_threads": torch.get_num_threads(),
    }
