"""`egovcp-info`: versions, hardware and planner backends, for bug reports."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any

from egovcp.cli import run_command
from egovcp.completion import Shell, completion_script
from egovcp.errors import EnvironmentFailure
from egovcp.hardware import available_bytes, hardware
from egovcp.outputs import output_file, write_report
from egovcp.plan.backends import library
from egovcp.terminal import echo, echo_lines

_PACKAGES = (
    *("egovcp", "egovcp-collect", "egovcp-train", "egovcp-deploy", "egovcp-experiment"),
    *("torch", "numpy", "lerobot", "datasets", "huggingface-hub", "mujoco", "mjlab", "rerun-sdk"),
)


@dataclass(frozen=True)
class MachineInfoConfig:
    """Show versions, hardware and the planner backends that this machine can use."""

    json: str = output_file()
    """Also write everything to this JSON file."""
    completion: Shell | None = None
    """Instead, print the completion script of all commands for this shell."""


def show(config: MachineInfoConfig) -> None:
    """Print the report, and write it if a file is given; or print a completion script."""
    if config.completion:
        echo(completion_script(config.completion))
        return
    report = machine_report()
    write_report(config.json, report)
    flat = report | {f"planner backend {k}": v for k, v in report["planner_backends"].items()}
    flat |= report["versions"]
    echo_lines(f"{k:24} {v}" for k, v in flat.items() if not isinstance(v, dict))


def machine_report() -> dict[str, Any]:
    """``versions`` and ``planner_backends`` by name, and the flat metrics of `hardware`."""
    return {
        "platform": platform.platform(),
        "python": platform.python_version(),
        **hardware(),
        "available_memory_gb": round(available_bytes() / 1e9, 1),
        "planner_backends": {"eager": "available", "float32": "available", "int8": _int8()},
        "versions": {name: _version(name) for name in _PACKAGES},
    }


def _int8() -> str:
    try:
        library.load_kernel()
    except EnvironmentFailure as error:
        return f"unavailable: {error}"
    return "available" if library.processor_is_fast() else "available, but slow on this processor"


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(MachineInfoConfig, show, argv, prog="egovcp-info")
