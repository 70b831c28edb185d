"""Where the arithmetic happens."""

from __future__ import annotations

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
