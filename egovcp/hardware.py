"""The machine in words that mean something to somebody else."""

from __future__ import annotations

import os
import platform
from pathlib import Path


def hardware() -> dict[str, object]:
    """What figures of speed and time depend on."""
    import torch  # here, so that a process that only simulates does not hold it

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
