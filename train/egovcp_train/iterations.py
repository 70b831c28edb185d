"""The loop of the learners that simulate and update by turns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from tqdm import tqdm

from egovcp.stop_signals import stop_on_signal
from egovcp_train.loop import Budget
from egovcp_train.records import Records


class Iterative(Protocol):
    """Collects and learns, a while at a time."""

    iteration: int
    """How many iterations it has done."""

    @property
    def steps(self) -> int:
        """What they took, over all robots."""
        ...

    def iterate(self) -> dict[str, float]:
        """One more; returns scalars to log."""
        ...


def run_iterations(
    learner: Iterative,
    budget: Budget,
    recorder: Records,
    save: Callable[[], None],
    save_freq: int,
    summary: Callable[[dict[str, float]], dict[str, str]],
) -> bool:
    """Learn until the budget or a signal ends it; the last state is always saved.

    Returns whether the budget is spent.
    """
    start = learner.iteration
    with (
        stop_on_signal() as stopped,
        tqdm(
            total=budget.steps,
            initial=learner.steps,
            unit="step",
            unit_scale=True,
            desc="ppo",
            mininterval=2.0,
        ) as bar,
    ):
        while budget.progress(learner.steps) < 1.0 and not stopped:
            scalars = learner.iterate()
            recorder.scalars(learner.steps, scalars)
            bar.set_postfix(summary(scalars), refresh=False)
            bar.update(learner.steps - bar.n)
            if learner.iteration % save_freq == 0:
                save()
    if learner.iteration > start and learner.iteration % save_freq:
        save()
    recorder.close()
    return budget.progress(learner.steps) >= 1.0
