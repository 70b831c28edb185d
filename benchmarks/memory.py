"""Resident memory of a whole collection, and whether it grows with the number of episodes.

Runs `egovcp-collect` twice and sums the resident memory of all its processes ten times per second.
Pages that several processes share count once for each.

    python benchmarks/memory.py --episodes 200 800
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time

import psutil
from report import parser, publish


def resident_mb(process: psutil.Process) -> float:
    """Resident memory of a process and its descendants."""
    total = 0
    for each in (process, *process.children(recursive=True)):
        try:
            total += each.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total / 1e6


def peak_mb(task: str, episodes: int) -> float:
    """Peak memory of a collection."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "egovcp_collect.collect", f"--task={task}"]
        service = psutil.Popen(
            [*command, f"--dataset.root={folder}/dataset", f"--episodes={episodes}"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        peak = 0.0
        while service.poll() is None:
            peak = max(peak, resident_mb(service))
            time.sleep(0.1)
        if service.returncode:
            raise SystemExit(f"egovcp-collect failed with exit code {service.returncode}")
    return peak


def main() -> None:
    """Measure and print."""
    options = parser(__doc__, rounds=None)
    options.add_argument("--task", default="ball", help="ball, wall or arch")
    options.add_argument("--episodes", type=int, nargs=2, default=[200, 800])
    args = options.parse_args()
    few, many = (peak_mb(args.task, episodes) for episodes in args.episodes)
    publish(
        {
            "episodes_few": args.episodes[0],
            "episodes_many": args.episodes[1],
            "resident_few_mb": few,
            "resident_many_mb": many,
            "growth_ratio": many / few,
        },
        args.json,
    )


if __name__ == "__main__":
    main()
