"""Installed size of each application with all its dependencies, MB.

Sums the files of every distribution that the application requires, as installed in this
environment; "without torch" leaves out torch, triton and the distributions nvidia-* and cuda-*.
Of packages in editable mode, such as those of egovcp here, only the metadata count.

    python benchmarks/install_size.py
"""

from __future__ import annotations

import re
import sys
from functools import cache
from importlib import metadata
from pathlib import Path

from report import parser, publish

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for tests.support

from tests.support.requirements import required_distributions

APPLICATIONS = ("egovcp", "egovcp-collect", "egovcp-train", "egovcp-deploy", "egovcp-experiment")
_TORCH = re.compile(r"torch|triton|(nvidia|cuda)-.+")  # whole names


@cache
def size_mb(name: str) -> float:
    """Size of the files of one distribution."""
    paths = [Path(str(file.locate())) for file in metadata.files(name) or []]
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def sizes_mb() -> dict[str, object]:
    """Size of every application, with and without torch."""
    metrics: dict[str, object] = {}
    for application in APPLICATIONS:
        sizes = {name: size_mb(name) for name in required_distributions(application)}
        without = sum(mb for name, mb in sizes.items() if not _TORCH.fullmatch(name))
        metrics[f"{application}_mb"] = sum(sizes.values())
        metrics[f"{application}_without_torch_mb"] = without
    return metrics


if __name__ == "__main__":
    publish(sizes_mb(), parser(__doc__, rounds=None).parse_args().json)
