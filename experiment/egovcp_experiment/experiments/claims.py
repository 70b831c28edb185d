"""Claims that one row of a table has more reward than another on the same scenarios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any, Final

import numpy as np

from egovcp.eval_scores import Gain
from egovcp_experiment import results
from egovcp_experiment.report import listed

WORDS: Final = (
    "holds",
    "holds on average only",
    "contradicted",
    "contradicted on average only",
    "undecided",
)
#: 97.5 % quantiles of Student's t for 1 to 9 degrees of freedom; the last serves beyond, too.
_T975: Final = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)


@dataclass(frozen=True)
class Claim:
    """Row ``above`` has more reward than row ``below``."""

    above: str
    below: str
    tasks: tuple[str, ...]
    """Tasks for which it is claimed."""


@dataclass(frozen=True)
class Verdict:
    """Results for a claim on one task."""

    claim: Claim
    task: str
    gain: Gain
    """``above`` minus ``below``."""
    differences: tuple[float, ...]
    """The same difference in reward per step, of each training of both."""

    @property
    def agreeing(self) -> int:
        """Trainings in which ``above`` has more reward."""
        return sum(difference > 0 for difference in self.differences)

    @property
    def word(self) -> str:
        """One of `WORDS`, by the interval of the reward."""
        holds = WORDS[0] if self.agreeing == len(self.differences) else WORDS[1]
        contradicted = WORDS[2] if self.agreeing == 0 else WORDS[3]
        return self.gain.word(holds, contradicted, WORDS[4])

    @property
    def over_trainings(self) -> tuple[float, float] | None:
        """Mean of the differences and half of its 95 % interval by Student's t; None for a single
        training."""
        n = len(self.differences)
        if n < 2:
            return None
        quantile = _T975[min(n - 1, len(_T975)) - 1]
        half = quantile * float(np.std(self.differences, ddof=1)) / sqrt(n)
        return float(np.mean(self.differences)), half

    def metrics(self) -> dict[str, Any]:
        """The verdict as JSON values."""
        return {
            "above": self.claim.above,
            "below": self.claim.below,
            "task": self.task,
            "verdict": self.word,
            "reward_gain": self.gain.reward,
            "reward_gain_ci95": list(self.gain.reward_interval),
            "reward_gain_of_seeds": list(self.differences),
            "success_gain": self.gain.success,
            "success_gain_ci95": list(self.gain.success_interval),
            "seeds_in_favour": self.agreeing,
            "seeds": len(self.differences),
        }


def judge(
    claim: Claim, task: str, rows: Mapping[str, Sequence[str]], records: results.Records
) -> Verdict | None:
    """The verdict from the trainings that both rows have; None without any.

    ``rows``: row -> names of its cells, one per training seed.
    """
    pairs = zip(rows.get(claim.above, ()), rows.get(claim.below, ()), strict=False)
    both = [(above, below) for above, below in pairs if above in records and below in records]
    ours = results.eval_scores(records, [above for above, _ in both], task)
    theirs = results.eval_scores(records, [below for _, below in both], task)
    if ours is None or theirs is None:
        return None
    differences = tuple((ours.reward_of_seeds - theirs.reward_of_seeds).tolist())
    return Verdict(claim, task, ours.gain(theirs), differences)


def count_verdicts(verdicts: Sequence[Verdict]) -> str:
    """Number of verdicts of each kind: ``9 hold and 1 is undecided``."""
    words = [verdict.word for verdict in verdicts]
    parts = []
    for word in (w for w in WORDS if w in words):
        count = words.count(word)
        verb = ("is " if count == 1 else "are ") * (not word.startswith("holds"))
        parts.append(f"{count} {verb}{word if count == 1 else word.replace('holds', 'hold')}")
    return listed(parts)
