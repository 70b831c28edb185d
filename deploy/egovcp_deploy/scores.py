"""Metrics of evaluated episodes: rates and means with 95 % confidence intervals, and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from egovcp.eval_scores import EvalScores, signed_range, wilson
from egovcp.terminal import one_line

#: Task -> controller -> episodes.
type ScoreTable = Mapping[str, Mapping[str, Sequence[EpisodeScore]]]

_HEAD: Final = ("task", "controller", "success", "95 %", "reward/step", "95 %", "plan ms", "p99")


@dataclass(frozen=True)
class EpisodeScore:
    """One episode, played by one controller."""

    episode: int  # index of the scenario
    steps: int  # until the time limit or the fall
    reward: float  # sum over the episode
    success: bool
    terminated: bool
    plan_ms: list[float] = field(default_factory=list)  # per step; of robots together: per robot
    skipped: int = 0  # observations whose state was not finite, so that the policy did not use them
    parts: dict[str, bool] = field(default_factory=dict)  # success of each part of a sequence
    terms: dict[str, float] = field(default_factory=dict)  # reward term -> sum over the episode


def paired(
    scores: Sequence[EpisodeScore], others: Sequence[EpisodeScore]
) -> tuple[list[EpisodeScore], list[EpisodeScore]]:
    """The episodes of the scenarios that both have played, in the order of the scenarios."""
    a, b = ({score.episode: score for score in each} for each in (scores, others))
    common = sorted(a.keys() & b.keys())
    return [a[i] for i in common], [b[i] for i in common]


def eval_scores(scores: Sequence[EpisodeScore]) -> EvalScores:
    """The episodes as one row of `EvalScores`."""
    rows = [[score.reward, score.steps, score.success] for score in scores]
    reward, steps, success = np.array(rows, np.float64).T[:, None]
    return EvalScores(reward, steps, success)


# --- eval.json -------------------------------------------------------------------------------
def summarise(scores: Sequence[EpisodeScore]) -> dict[str, Any]:
    """Metrics of one controller on one task, with the keys of ``eval.json``; for a sequence also
    ``parts``: part -> ``success_rate`` and ``success_ci95``."""
    plan_ms = np.concatenate([score.plan_ms for score in scores])
    parts = {name: _successes([score.parts[name] for score in scores]) for name in scores[0].parts}
    found = eval_scores(scores)
    return {
        "episodes": len(scores),
        **_successes([score.success for score in scores]),
        "reward_mean": found.reward_per_step,
        "reward_ci95": list(found.reward_interval),
        "plan_ms_p50": float(np.percentile(plan_ms, 50)),
        "plan_ms_p99": float(np.percentile(plan_ms, 99)),
        **({"parts": parts} if parts else {}),
    }


def _successes(successes: Sequence[bool]) -> dict[str, Any]:
    count, total = sum(successes), len(successes)
    return {"success_rate": count / total, "success_ci95": list(wilson(count, total))}


def summary(scores: ScoreTable, requested: int) -> dict[str, dict[str, dict[str, Any]]]:
    """``{task: {controller: metrics}}``, the content of ``eval.json``. Metrics of fewer than
    ``requested`` episodes also hold ``incomplete`` (true) and ``episodes_requested``."""
    missing = {"incomplete": True, "episodes_requested": requested}
    return {
        task: {
            name: summarise(played) | (missing if len(played) < requested else {})
            for name, played in row.items()
        }
        for task, row in scores.items()
    }


# --- tables ----------------------------------------------------------------------------------
def table(figures: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """The content of ``eval.json`` as text: one line per task and controller."""
    lines: list[tuple[str, ...]] = [_HEAD]
    for task, row in figures.items():
        for name, f in row.items():
            lines.append(
                (
                    task,
                    name,
                    *_success_cells(f),
                    f"{f['reward_mean']:+.5f}",
                    signed_range(f["reward_ci95"]),
                    f"{f['plan_ms_p50']:.2f}",
                    f"{f['plan_ms_p99']:.2f}",
                )
            )
            for part, successes in f.get("parts", {}).items():
                lines.append(("", f"- {part}", *_success_cells(successes), "", "", "", ""))
    return aligned(lines, text_columns=2)


def _success_cells(figures: Mapping[str, Any]) -> tuple[str, str]:
    low, high = figures["success_ci95"]
    return f"{figures['success_rate']:.1%}", f"{low:.1%} to {high:.1%}"


def aligned(lines: Sequence[Sequence[str]], text_columns: int) -> str:
    """A table with columns of equal width: the first ``text_columns`` left-aligned, the others
    right-aligned."""
    lines = [[one_line(cell) for cell in line] for line in lines]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i < text_columns else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
