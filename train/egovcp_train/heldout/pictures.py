"""Pictures of a report: open-loop strips and the calibration of Q."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import PLANNER_DT
from egovcp_train.heldout.report import Report, Values
from egovcp_train.heldout.strips import STRIP, Strip

_DPI: Final = 100
_GAP: Final = 2  # pixels between pictures
_POINTS: Final = 3000  # of the rows that the scatter shows

type Image = NDArray[np.uint8]


def draw(report: Report) -> dict[str, Image]:
    """``open_loop_TASK`` and ``value_TASK`` -> (height, width, 3) picture."""
    out: dict[str, Image] = {}
    for task, found in report.strips.items():
        if found:
            out[f"open_loop_{task}"] = strip_picture(found)
    for task, values in report.values.items():
        if len(values.value):
            out[f"value_{task}"] = calibration_picture(values, report.tasks[task]["value"])
    return out


def strip_picture(strips: Sequence[Strip]) -> Image:
    """Two lines per strip, seen and foreseen, one column per horizon; near is bright."""
    lines = [_line(images) for strip in strips for images in (strip.seen, strip.foreseen)]
    sheet = np.concatenate(lines)
    height, width = sheet.shape[0] / len(lines), sheet.shape[1] / len(STRIP)
    figure, axes = _figure(1.2 * len(STRIP), 0.95 * len(lines) + 0.4)
    axes.imshow(sheet, cmap="magma", vmin=0.0, vmax=1.0, interpolation="nearest")
    ticks = [f"+{k} ({1e3 * k * PLANNER_DT:.0f} ms)" for k in STRIP]
    axes.set_xticks([(i + 0.5) * width for i in range(len(STRIP))], ["filtered", *ticks[1:]])
    names = [f"{what}\nrow {s.start}" for s in strips for what in ("seen", "foreseen")]
    axes.set_yticks([(i + 0.5) * height for i in range(len(lines))], names)
    axes.tick_params(length=0, labelsize=8)
    return _pixels(figure)


def calibration_picture(values: Values, found: dict[str, Any]) -> Image:
    """Q against the Monte Carlo return, with the diagonal and the regression."""
    pick = np.linspace(0, len(values.value) - 1, min(_POINTS, len(values.value))).astype(int)
    q, target = values.value.numpy()[pick], values.target.numpy()[pick]
    figure, axes = _figure(5.0, 5.0)
    axes.scatter(q, target, s=3, alpha=0.3, color="#7570b3", linewidths=0)
    middle = float(values.value.mean()), float(values.target.mean())
    axes.axline((0.0, 0.0), slope=1, color="#8a8f98", lw=1)
    if found["slope"] is not None:
        axes.axline(middle, slope=found["slope"], color="#d95f02", lw=1.5)
    words = [f"{k} {found[k]:.3f}" for k in ("slope", "r2", "bias") if found[k] is not None]
    axes.set(xlabel="Q", ylabel="Monte Carlo return", title=", ".join(words))
    return _pixels(figure)


def _line(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, 48, 64) -> one line of pictures with gaps of no colour between them."""
    padded = np.pad(images, ((0, 0), (0, _GAP), (0, _GAP)), constant_values=np.nan)
    return np.concatenate(list(padded), axis=1)


def _figure(width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # half a second
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _pixels(figure: Any) -> Image:
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba(), dtype=np.uint8)[..., :3]
