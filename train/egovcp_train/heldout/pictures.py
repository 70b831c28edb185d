"""A held-out report as text, as pictures, and as a Rerun recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.model.depth import to_metres
from egovcp.packages import is_installed
from egovcp.robot_spec import G1
from egovcp_train.heldout.open_loop import HORIZONS, STRIP_HORIZONS, ImageStrip
from egovcp_train.heldout.report import HeldoutReport, Values

if TYPE_CHECKING:
    import rerun.blueprint as rrb

RECORDING: Final = "open_loop.rrd"
_DPI: Final = 100
_GAP: Final = 2  # pixels between images
_POINTS: Final = 3000  # of the scatter plot
_KINDS: Final = ("observed", "predicted")
_REGIONS: Final = {
    "valid": "depth, all pixels",
    "near": "depth, nearer than 1.5 m",
    "moving": "depth, moving",
}

type Image = NDArray[np.uint8]


# --- text ----------------------------------------------------------------------------
def table(tasks: Mapping[str, Mapping[str, Any]]) -> str:
    """A block per task; errors as model / repeated, depth in mm, state in standard deviations."""
    return "\n\n".join(_block(task, report) for task, report in tasks.items())


def _block(task: str, report: Mapping[str, Any]) -> str:
    latent, value = report["latent"], report["value"]
    ends = report["termination"].items()
    aucs = (f"{_number(s['auc'], 3)} within {k} ({s['failing']} of {s['rows']})" for k, s in ends)
    head = f"{task}: {report['episodes']} episodes, {report['rows']} rows"
    lines = [
        f"{head}; model / last one repeated, by ticks ahead",
        _line("", (str(k) for k in HORIZONS)),
    ]
    for region, name in _REGIONS.items():
        errors = report["depth"][region].values()
        if any(e["pixels"] for e in errors):
            cells = (_pair(e["model_mm"], e["repeat_mm"], 0) for e in errors)
            lines.append(_line(f"{name}, mm", cells))
    for group, by_horizon in report["state"].items():
        cells = (_pair(e["model"], e["repeat"], 2) for e in by_horizon.values())
        lines.append(_line(group, cells))
    if (error := report.get("object_rmse_m")) is not None:
        lines.append(f"object  position {error:.3f} m RMSE")
    return "\n".join(
        [
            *lines,
            f"termination AUC  {', '.join(aucs)} rows",
            _value(value),
            f"latent  {latent['active']} of {latent['dimensions']} dimensions active, "
            f"KL {latent['kl_nats']:.2f} nats",
        ]
    )


def _value(found: Mapping[str, Any]) -> str:
    ranked = "ranking" in found
    target = "privileged value" if ranked else "return"
    kinds = (("correlation", 3), ("R2", 3), ("slope", 2), ("bias", 3))
    parts = [f"{name} {_number(found[name.lower()], digits)}" for name, digits in kinds]
    parts += [f"ranking {_number(found['ranking'], 3)}"] if ranked else []
    return f"Q and {target}  {', '.join(parts)} on {found['rows']} rows"


def _line(name: str, cells: Iterable[str]) -> str:
    return f"  {name:<32}" + "".join(f"{cell:>13}" for cell in cells)


def _pair(model: float | None, repeat: float | None, digits: int) -> str:
    return "-" if model is None else f"{_number(model, digits)} / {_number(repeat, digits)}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


# --- pictures ------------------------------------------------------------------------
def draw(report: HeldoutReport) -> dict[str, Image]:
    """``open_loop_TASK`` and ``value_TASK`` -> (height, width, 3) picture."""
    out: dict[str, Image] = {}
    for task, found in report.strips.items():
        if found:
            out[f"open_loop_{task}"] = strip_picture(found, report.planner_hz)
    for task, values in report.values.items():
        if len(values.value):
            out[f"value_{task}"] = calibration_picture(values, report.tasks[task]["value"])
    return out


def strip_picture(strips: Sequence[ImageStrip], planner_hz: int = G1.planner_hz) -> Image:
    """Two rows per strip, observed and predicted; one column per horizon; near is bright."""
    lines = [_joined(images) for strip in strips for images in (strip.observed, strip.predicted)]
    sheet = np.concatenate(lines)
    height, width = sheet.shape[0] / len(lines), sheet.shape[1] / len(STRIP_HORIZONS)
    figure, axes = _figure(1.2 * len(STRIP_HORIZONS), 0.95 * len(lines) + 0.4)
    axes.imshow(sheet, cmap="magma", vmin=0.0, vmax=1.0, interpolation="nearest")
    ticks = [f"+{k} ({1e3 * k / planner_hz:.0f} ms)" for k in STRIP_HORIZONS]
    axes.set_xticks([(i + 0.5) * width for i in range(len(ticks))], ["filtered", *ticks[1:]])
    names = [f"{kind}\nrow {s.start}" for s in strips for kind in _KINDS]
    axes.set_yticks([(i + 0.5) * height for i in range(len(lines))], names)
    axes.tick_params(length=0, labelsize=8)
    return _pixels(figure)


def calibration_picture(values: Values, found: dict[str, Any]) -> Image:
    """Q against its target, with the diagonal and the regression."""
    pick = np.linspace(0, len(values.value) - 1, min(_POINTS, len(values.value))).astype(int)
    q, target = values.value[:, 0].numpy()[pick], values.target[:, 0].numpy()[pick]
    figure, axes = _figure(5.0, 5.0)
    axes.scatter(q, target, s=3, alpha=0.3, color="#7570b3", linewidths=0)
    middle = float(values.value[:, 0].mean()), float(values.target[:, 0].mean())
    axes.axline((0.0, 0.0), slope=1, color="#8a8f98", lw=1)
    if found["slope"] is not None:
        axes.axline(middle, slope=found["slope"], color="#d95f02", lw=1.5)
    words = [f"{k} {found[k]:.3f}" for k in ("slope", "r2", "bias") if found[k] is not None]
    axes.set(xlabel="Q", ylabel="target of Q", title=", ".join(words))
    return _pixels(figure)


def _joined(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, H, W) -> one row of images with transparent gaps."""
    padded = np.pad(images, ((0, 0), (0, _GAP), (0, _GAP)), constant_values=np.nan)
    return np.concatenate(list(padded), axis=1)


def _figure(width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # takes half a second
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _pixels(figure: Any) -> Image:
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba(), dtype=np.uint8)[..., :3]


# --- recording -----------------------------------------------------------------------
def record(report: HeldoutReport, folder: Path, depth_max_m: float) -> Path | None:
    """Write ``FOLDER/open_loop.rrd``: observed beside predicted depth images, per task.

    Entities ``/TASK/NUMBER/observed`` and ``.../predicted``, in mm, on the timelines
    ``ticks_ahead`` and ``time_ahead``. It replaces an earlier one.

    Returns:
        The file; None if rerun is not installed, or no episode is long enough.
    """
    if not is_installed("rerun") or not any(report.strips.values()):
        return None
    import rerun as rr  # takes half a second

    from egovcp.log.rerun import depth_style

    path = folder / RECORDING
    stream = rr.RecordingStream("egovcp_open_loop")
    stream.save(path, default_blueprint=_blueprint(report))
    ahead = [
        rr.TimeColumn("ticks_ahead", sequence=STRIP_HORIZONS),
        rr.TimeColumn("time_ahead", duration=[k / report.planner_hz for k in STRIP_HORIZONS]),
    ]
    for task, found in report.strips.items():
        for number, strip in enumerate(found):
            for kind in _KINDS:
                entity = f"/{task}/{number}/{kind}"
                stream.log(entity, depth_style(), static=True)
                buffers = _buffers(getattr(strip, kind), depth_max_m)
                stream.send_columns(entity, ahead, rr.DepthImage.columns(buffer=buffers))
    stream.flush()
    stream.disconnect()
    return path


def _buffers(near: NDArray[np.float32], depth_max_m: float) -> list[NDArray[np.uint8]]:
    """(n, H, W) nearness -> n images in uint16 mm, as bytes."""
    from egovcp.log.messages import to_millimetres

    metres = to_metres(torch.from_numpy(near), depth_max_m).numpy()
    return [np.ascontiguousarray(to_millimetres(m)).view(np.uint8).ravel() for m in metres]


def _blueprint(report: HeldoutReport) -> rrb.Blueprint:
    """A tab per task; observed beside predicted, one row per prediction; played in a loop."""
    import rerun.blueprint as rrb

    tabs = []
    for task, found in report.strips.items():
        lines = [
            rrb.Horizontal(
                *(
                    rrb.Spatial2DView(
                        name=f"{kind}, from row {strip.start}", origin=f"/{task}/{number}/{kind}"
                    )
                    for kind in _KINDS
                )
            )
            for number, strip in enumerate(found)
        ]
        tabs.append(rrb.Vertical(*lines, name=task))
    time = rrb.TimePanel(
        state="collapsed", timeline="time_ahead", play_state="playing", loop_mode="all"
    )
    return rrb.Blueprint(rrb.Tabs(*tabs), time, collapse_panels=True)
