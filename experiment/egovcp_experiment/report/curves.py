"""Success and reward against the transitions that a learner has seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from egovcp_experiment.outcomes import Outcome
from egovcp_experiment.report.document import Plot
from egovcp_experiment.report.svg import drawn


@dataclass(frozen=True)
class Curve:
    """One learner on one task."""

    label: str
    points: Mapping[int, Outcome]
    """Transitions -> what it does after so many."""
    colour: str
    """Matplotlib's."""
    style: str = "o-"
    """Matplotlib's marks and lines."""


def transitions_plot(name: str, caption: str, curves: Sequence[Curve]) -> Plot:
    """All of them on the same axes, with their 95 % intervals."""

    def paint(figure: Any) -> None:
        from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

        left, right = figure.subplots(1, 2)
        for curve in curves:
            outcomes = list(curve.points.values())
            success = [(o.success_rate, *o.success_interval) for o in outcomes]
            reward = [(o.reward_per_step, *o.reward_interval) for o in outcomes]
            _line(left, curve, [[100 * v for v in row] for row in success])
            _line(right, curve, reward)
        for axes, words in ((left, "success, %"), (right, "reward per step")):
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))  # less than a decade, too
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.set(xlabel="transitions", ylabel=words)
        left.legend(fontsize=8)

    return drawn(name, f"{caption}, 95 % intervals", paint)


def _line(axes: Any, curve: Curve, rows: Sequence[Sequence[float]]) -> None:
    """Rows of middle, lower and upper end; a single point has a bar in the place of a band."""
    xs = list(curve.points)
    middle, low, high = zip(*rows, strict=True)
    axes.plot(xs, middle, curve.style, color=curve.colour, label=curve.label)
    if len(xs) == 1:
        axes.plot(xs * 2, [low[0], high[0]], color=curve.colour, linewidth=1)
    else:
        axes.fill_between(xs, low, high, color=curve.colour, alpha=0.15, linewidth=0)
