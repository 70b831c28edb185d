"""Plot of paired differences, one panel per task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from egovcp.eval_scores import Interval
from egovcp_experiment.report import Plot, draw


class Difference(NamedTuple):
    """A paired difference in units of the plot."""

    value: float
    interval: Interval
    colour: str = "C0"
    """Of Matplotlib."""


def gain_plot(
    name: str,
    caption: str,
    panels: Mapping[str, Mapping[str, Difference]],
    label: str,
    marks: Sequence[float] = (),
) -> Plot:
    """Differences with their intervals, and a line at zero.

    Args:
        panels: title -> variant -> difference; at least one panel.
        label: of the horizontal axes, with the unit.
        marks: values of dotted lines.
    """

    def paint(figure: Any) -> None:
        columns = figure.subplots(1, len(panels), squeeze=False)[0]
        for axes, (title, differences) in zip(columns, panels.items(), strict=True):
            for row, each in enumerate(differences.values()):
                axes.plot(each.interval, [row, row], color=each.colour, linewidth=1.5)
                axes.plot([each.value], [row], "o", color=each.colour, markersize=4)
            axes.set_yticks(range(len(differences)), list(differences), fontsize=7)
            axes.invert_yaxis()
            axes.axvline(0, color="0.7", linewidth=0.8, zorder=0)
            for mark in marks:
                axes.axvline(mark, color="0.7", linewidth=0.8, linestyle=":", zorder=0)
            axes.set_title(title, fontsize=9)
            axes.set_xlabel(label)

    rows = max(map(len, panels.values()))
    return draw(name, caption, paint, (max(8.0, 3.2 * len(panels)), 0.9 + 0.2 * rows))
