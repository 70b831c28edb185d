"""The training curve of a low-level controller, from its TensorBoard records, as table and picture.

    python -m egovcp_train.lowlevel.curve RUN [RUN ...] --out docs/lowlevel_training

Writes OUT.csv and OUT.png. Several runs, in order, are a run and its continuations in other
folders: what a continuation did again counts instead of what it had continued from.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from egovcp.errors import ArtifactError, EgovcpError
from egovcp.terminal import echo

COLUMNS: Final = {
    "difficulty": "episode/difficulty",
    "falls per robot and minute": "falls_per_second",
    "velocity reward": "reward/velocity",
    "reward per second": "reward/total",
}
_POINTS: Final = 200


def read(runs: Sequence[Path]) -> list[dict[str, float]]:
    """About 200 rows of steps and `COLUMNS`, each the mean of its stretch of the runs.

    Args:
        runs: output folders of a run and of its continuations, in order.

    Raises:
        ArtifactError: a folder holds no records of a training of the low-level controller.
    """
    series: dict[str, list[Any]] = {name: [] for name in COLUMNS}
    for run in runs:
        for name, points in _records(run).items():
            series[name] = [p for p in series[name] if p.step < points[0].step] + points
    count = min(len(points) for points in series.values())
    stretch = max(1, count // _POINTS)
    rows = []
    for begin in range(0, count - stretch + 1, stretch):
        part = slice(begin, begin + stretch)
        row = {"steps": float(series["difficulty"][begin + stretch - 1].step)}
        row |= {name: _mean(points[part]) for name, points in series.items()}
        row["falls per robot and minute"] *= 60
        rows.append(row)
    return rows


def _records(run: Path) -> dict[str, list[Any]]:
    """One run's scalars of `COLUMNS`; not empty."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = run / "tensorboard"
    records = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    if folder.is_dir():
        records.Reload()
    missing = sorted(set(COLUMNS.values()) - set(records.Tags()["scalars"]))
    if missing:
        raise ArtifactError(
            f"{folder}: no records of {', '.join(missing)}; expected those of an output folder "
            "of egovcp-train-lowlevel that has finished an iteration, with --tensorboard=true"
        )
    return {name: records.Scalars(tag) for name, tag in COLUMNS.items()}


def _mean(points: list[Any]) -> float:
    return float(np.mean([point.value for point in points]))


def write(rows: list[dict[str, float]], out: Path) -> None:
    """OUT.csv and OUT.png."""
    with out.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(rows[0])
        table.writerows([f"{value:.4g}" for value in row.values()] for row in rows)
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(COLUMNS), figsize=(14, 3), layout="constrained")
    for axis, name in zip(axes, COLUMNS, strict=True):
        axis.plot([row["steps"] / 1e6 for row in rows], [row[name] for row in rows])
        axis.set(title=name, xlabel="million steps of 20 ms")
        axis.grid(alpha=0.3)
    figure.savefig(out.with_suffix(".png"), dpi=80)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> int:
    """Read runs, write their curve; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="--output_dir of egovcp-train-lowlevel"
    )
    parser.add_argument("--out", type=Path, required=True, help="path without ending")
    args = parser.parse_args(argv)
    try:
        write(read(args.runs), args.out)
    except EgovcpError as error:
        echo(f"{parser.prog}: {error}", error=True)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
