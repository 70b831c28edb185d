"""The figures of an evaluation as JSON values and as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from egovcp.terminal import one_line
from egovcp_deploy.scores import EpisodeScore, paired, success_gain, success_rate, summarise

type Played = Mapping[str, Mapping[str, Sequence[EpisodeScore]]]

_HEAD: Final = ("task", "controller", "success", "95 %", "reward/step", "95 %", "plan ms", "p99")


def summary(scores: Played, requested: int) -> dict[str, dict[str, dict[str, Any]]]:
    """``{task: {controller: figures}}``, the content of ``eval.json``.

    Where fewer than ``requested`` episodes were played, the figures say so: ``incomplete`` is true,
    and ``episodes_requested`` is there beside ``episodes``.
    """

    def figures(played: Sequence[EpisodeScore]) -> dict[str, Any]:
        missing = {"incomplete": True, "episodes_requested": requested}
        return summarise(played) | (missing if len(played) < requested else {})

    return {
        task: {name: figures(played) for name, played in row.items()}
        for task, row in scores.items()
    }


def gains(scores: Played) -> dict[str, dict[str, Any]]:
    """Task -> reference -> planner's success rate minus the reference's, paired by scenario; over
    the scenarios that both have played."""
    out: dict[str, dict[str, Any]] = {}
    for task, row in scores.items():
        out[task] = {}
        for name in row:
            ours, others = paired(row.get("planner", ()), row[name])
            if name != "planner" and ours:
                out[task][name] = {
                    "gain": success_rate(ours) - success_rate(others),
                    "ci95": list(success_gain(ours, others)),
                }
    return out


def table(figures: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """The figures for reading: one line per task and controller, columns aligned."""
    lines: list[tuple[str, ...]] = [_HEAD]
    for task, row in figures.items():
        for name, played in row.items():
            lines += [_line(task, name, played), *_parts(played.get("parts", {}))]
    return aligned(lines, words=2)


def aligned(lines: Sequence[Sequence[str]], words: int) -> str:
    """Columns of equal width: the first ``words`` to the left, numbers to the right."""
    lines = [[one_line(cell) for cell in line] for line in lines]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i < words else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _parts(parts: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Lines of the parts of a sequence, which have a success only."""
    blank = ("",) * (len(_HEAD) - 4)
    return [("", f"- {part}", *_success(figures), *blank) for part, figures in parts.items()]


def _success(figures: Mapping[str, Any]) -> tuple[str, str]:
    low, high = figures["success_ci95"]
    return f"{figures['success_rate']:.1%}", f"{low:.1%} to {high:.1%}"


def _line(task: str, name: str, figures: Mapping[str, Any]) -> tuple[str, ...]:
    worst, best = figures["reward_ci95"]
    return (
        task,
        name,
        *_success(figures),
        f"{figures['reward_mean']:+.5f}",
        f"{worst:+.5f} to {best:+.5f}",
        f"{figures['plan_ms_p50']:.2f}",
        f"{figures['plan_ms_p99']:.2f}",
    )
