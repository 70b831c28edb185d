"""Where the arithmetic happens."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager

import torch

from egovcp.errors import EnvironmentFailure, UsageError


def choose_device(name: str) -> torch.device:
    """The device that ``--device`` names.

    Raises:
        EnvironmentFailure: there is no such device here.
        UsageError: there is no such kind of device.
    """
    available = torch.cuda.is_available()
    if name == "auto":
        return torch.device("cuda" if available else "cpu")
    if name.startswith("cuda") and not available:
        raise EnvironmentFailure("--device=cuda, but torch finds no CUDA device; use --device=cpu")
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise UsageError(f"unknown --device {name!r}; expected cpu, cuda or auto") from error


def choose_bf16(name: str) -> bool:
    """Whether ``--mixed_precision`` asks for bfloat16; auto: as ``accelerate launch`` was told.

    Raises:
        UsageError: it asks for something else.
    """
    said = os.environ.get("ACCELERATE_MIXED_PRECISION", "no") if name == "auto" else name
    if said not in ("no", "bf16"):
        source = "accelerate launch " if name == "auto" else ""
        raise UsageError(f"{source}--mixed_precision={said}; expected no or bf16")
    return said == "bf16"


def precision(device: torch.device, bf16: bool) -> AbstractContextManager[object]:
    """Matrix products within are in bfloat16, if so; weights and sums stay in float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=bf16)
