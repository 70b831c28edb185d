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


def choose_bf16(name: str, device: torch.device) -> bool:
    """Whether matrix products are in bfloat16, as ``--mixed_precision`` asks.

    auto: as ``accelerate launch`` was told, else if the device computes in it: where bfloat16 is
    emulated it is slower than float32.

    Raises:
        UsageError: it asks for something else.
    """
    said = name
    if name == "auto":
        own = "bf16" if _computes_in_bf16(device) else "no"
        said = os.environ.get("ACCELERATE_MIXED_PRECISION", own)
    if said not in ("no", "bf16"):
        source = "accelerate launch " if name == "auto" else ""
        raise UsageError(f"{source}--mixed_precision={said}; expected no or bf16")
    return said == "bf16"


def _computes_in_bf16(device: torch.device) -> bool:
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    has = torch.cpu.get_capabilities() if device.type == "cpu" else {}
    return bool(has.get("avx512_bf16") or has.get("amx_bf16"))


def precision(device: torch.device, bf16: bool) -> AbstractContextManager[object]:
    """Matrix products within are in bfloat16, if so; weights and sums stay in float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=bf16)
