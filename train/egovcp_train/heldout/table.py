"""A report as text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from egovcp_train.heldout.open_loop import HORIZONS

_REGIONS = {
    "valid": "depth, all pixels",
    "near": "depth, nearer than 1.5 m",
    "moving": "depth, moving",
}


def table(tasks: Mapping[str, Mapping[str, Any]]) -> str:
    """A block per task; errors as model/repeated, depth in mm, state in deviations."""
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
        errors = report["depth"][region]
        if any(e["pixels"] for e in errors.values()):
            lines.append(
                _line(
                    f"{name}, mm", (_pair(e, "model_mm", "repeat_mm", 0) for e in errors.values())
                )
            )
    for group, errors in report["state"].items():
        lines.append(_line(group, (_pair(e, "model", "repeat", 2) for e in errors.values())))
    return "\n".join(
        [
            *lines,
            f"termination AUC  {', '.join(aucs)} rows",
            f"Q  slope {_number(value['slope'], 2)}, R2 {_number(value['r2'], 3)}, "
            f"bias {_number(value['bias'], 3)} on {value['rows']} rows",
            f"latent  {latent['active']} of {latent['dimensions']} dimensions active, "
            f"KL {latent['kl_nats']:.2f} nats",
        ]
    )


def _line(name: str, cells: Iterable[str]) -> str:
    return f"  {name:<32}" + "".join(f"{cell:>13}" for cell in cells)


def _pair(errors: Mapping[str, float | None], model: str, repeat: str, digits: int) -> str:
    if errors[model] is None:
        return "-"
    return f"{_number(errors[model], digits)} / {_number(errors[repeat], digits)}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
