"""Training curves as a picture, from the records of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

type Series = tuple[list[int], list[float]]

#: Title of a panel -> the scalars that it shows, with their labels.
_PANELS: Final[Mapping[str, Mapping[str, str]]] = {
    "loss": {"loss/total": "total"},
    "Q on held-out episodes": {"heldout/value/r2": "R²", "heldout/value/slope": "slope"},
    "moving pixels 4 ticks ahead, m": {
        "heldout/depth/moving_h4": "imagined",
        "heldout/depth/repeat_h4": "last image repeated",
    },
}
_DPI: Final = 100


def draw_curves(run: Path, path: Path) -> bool:
    """Draw the curves of the run in folder ``run`` to ``path``; whether there were any.

    None are drawn where nothing was recorded.
    """
    known = recorded(run / "tensorboard")
    panels = {
        title: {label: known[name] for name, label in names.items() if name in known}
        for title, names in _PANELS.items()
    }
    panels = {title: curves for title, curves in panels.items() if curves}
    if not panels:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    _figure(panels).savefig(path, dpi=_DPI, metadata={"Software": None})
    return True


def recorded(folder: Path) -> dict[str, Series]:
    """Scalar -> its steps and values; of a run that was resumed, all its parts."""
    if not folder.is_dir():
        return {}
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(str(folder), size_guidance={"scalars": 10_000}).Reload()
    out: dict[str, Series] = {}
    for name in found.Tags()["scalars"]:
        events = found.Scalars(name)
        out[name] = [e.step for e in events], [e.value for e in events]
    return out


def _figure(panels: Mapping[str, Mapping[str, Series]]) -> Any:
    from matplotlib.figure import Figure  # draws without a display

    figure = Figure(figsize=(4.0 * len(panels), 3.0), layout="constrained")
    for axes, (title, curves) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        for label, (steps, values) in curves.items():
            axes.plot(steps, values, label=label, marker="." if len(steps) < 20 else "")
        axes.set(title=title, xlabel="step")
        axes.grid(alpha=0.3)
        axes.legend()
    return figure
