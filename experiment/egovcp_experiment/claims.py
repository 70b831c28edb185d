"""Claims that one row plays better than another, weighed on the same scenarios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from egovcp.intervals import Interval
from egovcp_experiment.outcomes import outcome
from egovcp_experiment.report.document import points_range
from egovcp_experiment.store import Record

type Word = Literal["holds", "holds on average only", "contradicted", "undecided"]


@dataclass(frozen=True)
class Claim:
    """``above`` has more reward than ``below``."""

    above: str
    below: str
    tasks: tuple[str, ...]
    """Where that is claimed."""


@dataclass(frozen=True)
class Verdict:
    """What the results say of a claim on one task."""

    claim: Claim
    task: str
    reward: float
    """Reward per step of ``above`` minus that of ``below``."""
    reward_interval: Interval
    """95 %, over scenarios."""
    success: float
    """The same of the success rate."""
    success_interval: Interval
    """95 %, over scenarios."""
    of_wins: tuple[float, Interval] | None
    """The same of the reward in episodes in which both succeed; None where there are none."""
    agreeing: int
    """Trainings in which ``above`` has more reward."""
    seeds: int
    """Trainings that both have."""

    @property
    def word(self) -> Word:
        """By reward; an interval with zero in it decides nothing."""
        low, high = self.reward_interval
        if high < 0:
            return "contradicted"
        if low <= 0:
            return "undecided"
        return "holds" if self.agreeing == self.seeds else "holds on average only"

    @property
    def words(self) -> str:
        """The same with its figures."""
        low, high = self.reward_interval
        trainings = "" if self.seeds == 1 else f", in {self.agreeing} of {self.seeds} trainings"
        return (
            f"{self.word} ({self.reward:+.5f}, 95 % {low:+.5f} to {high:+.5f}{trainings}; success "
            f"{100 * self.success:+.1f} points, {points_range(self.success_interval)})"
        )

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return {
            "above": self.claim.above,
            "below": self.claim.below,
            "task": self.task,
            "verdict": self.word,
            "reward_gain": self.reward,
            "reward_gain_ci95": list(self.reward_interval),
            "success_gain": self.success,
            "success_gain_ci95": list(self.success_interval),
            "reward_gain_of_wins": self.of_wins[0] if self.of_wins else None,
            "reward_gain_of_wins_ci95": list(self.of_wins[1]) if self.of_wins else None,
            "seeds_in_favour": self.agreeing,
            "seeds": self.seeds,
        }


def weigh(
    claim: Claim,
    task: str,
    above: Mapping[int, str],
    below: Mapping[int, str],
    records: Mapping[str, Record],
) -> Verdict | None:
    """The verdict of the trainings that both have; None if there is none.

    Args:
        claim: what is claimed.
        task: what was played.
        above: training seed -> name of the cell that played it.
        below: the same of the other.
        records: results.
    """
    both = [s for s in above if above[s] in records and below.get(s) in records]
    ours = outcome(records, [above[s] for s in both], task)
    theirs = outcome(records, [below[s] for s in both], task)
    if ours is None or theirs is None:
        return None
    reward, reward_interval = ours.reward_gain(theirs)
    success, success_interval = ours.success_gain(theirs)
    each = ours.reward_of_seeds - theirs.reward_of_seeds
    return Verdict(
        claim,
        task,
        reward,
        reward_interval,
        success,
        success_interval,
        of_wins=ours.reward_gain_of_wins(theirs),
        agreeing=int((each > 0).sum()),
        seeds=len(both),
    )


def by_chance(verdicts: Sequence[Verdict]) -> str:
    """How many are of which kind, and how many of them luck alone would bring."""
    count = len(verdicts)
    words = [verdict.word for verdict in verdicts]
    kinds = ", ".join(f"{words.count(w)} {w}" for w in get_args(Word.__value__) if w in words)
    return (
        f"of {count} claims, one for each task: {kinds} (95 % intervals; were no two rows any "
        f"different, about {0.025 * count:.1f} would hold and as many be contradicted by chance)"
    )
