"""Drawings with Matplotlib, as SVG elements for a page."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

from egovcp_experiment.report.document import Plot


def drawn(
    name: str,
    caption: str,
    paint: Callable[[Any], None],
    size: tuple[float, float] = (8.0, 3.2),
) -> Plot:
    """``paint`` a `matplotlib.figure.Figure` of a size in inches.

    Args:
        name: of the drawing; equal names and equal paintings give equal files.
        caption: what is to be seen.
        paint: puts axes and curves into an empty figure.
        size: width and height, inches.
    """
    import matplotlib  # costs a second, and only reports draw
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(
        {"svg.fonttype": "none", "svg.hashsalt": name, "font.size": 9, "axes.grid": False}
    ):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(figure)
        paint(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    whole = text.getvalue()
    return Plot(name, caption, whole[whole.index("<svg") :].strip())
