"""Installed size of each application with all its dependencies, MB.

Sums the files of every distribution that the application requires, as installed in this
environment; "without torch" leaves out torch, its CUDA libraries and triton.

    python benchmarks/install_size.py
"""

from __future__ import annotations

from functools import cache
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from report import parser, publish

APPLICATIONS = ("egovcp", "egovcp-collect", "egovcp-train", "egovcp-deploy", "egovcp-experiment")
_TORCH = ("torch", "triton", "nvidia-", "cuda-")


def required(distribution: str) -> set[str]:
    """Names of the distributions that are installed with this one, without its extras."""
    found: set[tuple[str, str]] = set()

    def add(name: str, extra: str) -> None:
        if (name, extra) in found:
            return
        try:
            texts = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            return
        found.add((name, extra))
        for requirement in map(Requirement, texts):
            if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
                for inner in ("", *requirement.extras):
                    add(canonicalize_name(requirement.name), inner)

    add(canonicalize_name(distribution), "")
    return {name for name, _ in found}


@cache
def size_mb(name: str) -> float:
    """Size of the files of one distribution."""
    paths = [Path(str(file.locate())) for file in metadata.files(name) or []]
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def sizes_mb() -> dict[str, object]:
    """Size of every application, with and without torch."""
    figures: dict[str, object] = {}
    for application in APPLICATIONS:
        sizes = {name: size_mb(name) for name in required(application)}
        without = sum(mb for name, mb in sizes.items() if not name.startswith(_TORCH))
        figures[f"{application}_mb"] = sum(sizes.values())
        figures[f"{application}_without_torch_mb"] = without
    return figures


if __name__ == "__main__":
    publish(sizes_mb(), parser(__doc__, rounds=None).parse_args().json)
