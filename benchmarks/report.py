"""Shared by the benchmarks: options, timing, and output (one flat dict of metrics, with the
hardware)."""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from egovcp.hardware import hardware


def interleaved_times(
    cases: dict[str, Callable[[], object]], rounds: int
) -> dict[str, list[float]]:
    """Seconds of each case, ascending; the cases take turns, so that drift affects all of them."""
    times: dict[str, list[float]] = {name: [] for name in cases}
    for case in cases.values():
        case()
    for _ in range(rounds):
        for name, case in cases.items():
            start = time.perf_counter()
            case()
            times[name].append(time.perf_counter() - start)
    return {name: sorted(values) for name, values in times.items()}


def interleaved(cases: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each case; see `interleaved_times`."""
    times = interleaved_times(cases, rounds)
    return {name: statistics.median(values) for name, values in times.items()}


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Shows defaults, and keeps the lines of the description."""


def parser(
    description: str | None, rounds: int | None = 15, rounds_help: str = "measurements of each case"
) -> argparse.ArgumentParser:
    """Options that all benchmarks share.

    Args:
        rounds: default of ``--rounds``; None: there is no such option.
        rounds_help: what ``--rounds`` counts.
    """
    p = argparse.ArgumentParser(description=description, formatter_class=_HelpFormatter)
    p.add_argument("--json", type=Path, help="also write the metrics to this file")
    if rounds is not None:
        p.add_argument("--rounds", type=int, default=rounds, help=rounds_help)
    return p


def publish(metrics: dict[str, object], path: Path | None) -> None:
    """Print the metrics, one per line, and write them as JSON where asked."""
    metrics = {**metrics, **hardware()}
    width = max(map(len, metrics))
    for name, value in metrics.items():
        shown = f"{value:.4g}" if isinstance(value, float) else value
        print(f"{name:<{width}}  {shown}")
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
