"""Closed-loop outcomes side by side, paired with one of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from egovcp_experiment.outcomes import Outcome
from egovcp_experiment.report.document import (
    Plot,
    Table,
    number,
    percent,
    percent_range,
    points_range,
)
from egovcp_experiment.report.svg import drawn


def comparison(title: str, outcomes: Mapping[str, Outcome], reference: str) -> Table:
    """Success and reward of each, and the differences to ``reference`` on the same scenarios."""
    head = ["", "success", "95 %", "reward/step", "95 %", "sd over seeds"]
    base = outcomes.get(reference)
    if base is not None:
        head += [f"success - {reference} (points)", "95 %", f"reward - {reference}", "95 %"]
    rows = []
    for name, played in outcomes.items():
        low, high = played.reward_interval
        row = [
            name,
            percent(played.success_rate),
            percent_range(played.success_interval),
            f"{played.reward_per_step:+.5f}",
            f"{low:+.5f} to {high:+.5f}",
            number(played.reward_spread, ".5f"),
        ]
        if base is not None:
            row += _paired(played, base)
        rows.append(tuple(row))
    return Table(title, tuple(head), tuple(rows))


def _paired(played: Outcome, base: Outcome) -> list[str]:
    if played is base:
        return ["", "", "", ""]
    success, success_range = played.success_gain(base)
    reward, (low, high) = played.reward_gain(base)
    return [
        f"{100 * success:+.1f}",
        points_range(success_range),
        f"{reward:+.5f}",
        f"{low:+.5f} to {high:+.5f}",
    ]


def gain_plot(name: str, title: str, outcomes: Mapping[str, Outcome], reference: str) -> Plot:
    """Success and reward of each with their intervals."""

    def paint(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        labels = list(outcomes)
        _intervals(
            left,
            labels,
            [100 * o.success_rate for o in outcomes.values()],
            [tuple(100 * x for x in o.success_interval) for o in outcomes.values()],
            "success, %",
        )
        _intervals(
            right,
            labels,
            [o.reward_per_step for o in outcomes.values()],
            [o.reward_interval for o in outcomes.values()],
            "reward per step",
        )
        for axes, mark in (
            (left, 100 * outcomes[reference].success_rate if reference in outcomes else None),
            (right, outcomes[reference].reward_per_step if reference in outcomes else None),
        ):
            if mark is not None:
                axes.axvline(mark, color="0.7", linewidth=0.8, zorder=0)

    height = 0.9 + 0.25 * len(outcomes)
    return drawn(name, f"{title}, with 95 % intervals", paint, (8.0, height))


def _intervals(
    axes: Any, labels: list[str], middles: list[float], ranges: list[Any], title: str
) -> None:
    rows = range(len(labels))
    for row, middle, (low, high) in zip(rows, middles, ranges, strict=True):
        axes.plot([low, high], [row, row], color="C0", linewidth=1.5)
        axes.plot([middle], [row], "o", color="C0", markersize=4)
    axes.set_yticks(list(rows), labels)
    axes.invert_yaxis()
    axes.set_xlabel(title)
