"""Is a dataset worth training on? Each doubt as a sentence, from thresholds in one place."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from egovcp_collect.dataset.survey import Survey, TaskSurvey


@dataclass(frozen=True)
class Thresholds:
    """Below (or above) these a dataset is doubted.

    They are starting points: a trial with 2000 ball episodes, 800 blocks, taught a Q function
    to block; what has a tenth of its events has not been seen to.
    """

    moments: int = 100
    """Fewest episodes of a task in which its moment came: a block, a hit, a passage, a fall."""
    moments_per_1000: float = 0.5
    """Fewest such episodes per 1000 steps."""
    good_rows: float = 0.01
    """Smallest share of rows with an event ahead that pays."""
    valid_rows: float = 0.2
    """Smallest share of rows whose return the time limit does not cut short."""
    return_std: float = 0.02
    """Smallest standard deviation of the return: less is a constant."""
    one_outcome: float = 0.98
    """Largest share of episodes with the same outcome."""
    uniformity: float = 0.7
    """Least overlap of an action's histogram with an even one, 0 to 1."""
    occupied: float = 0.5
    """Smallest share of a hand's grid cells that hold an action."""
    valid_pixels: float = 0.05
    """Smallest share of depth pixels that were measured; an open room shows little but floor."""
    empty_frames: float = 0.25
    """Largest share of frames without a single measured pixel."""
    balance: float = 0.5
    """Smallest share of a task's steps, as a part of the even share."""


@dataclass(frozen=True)
class Finding:
    """One judgement about one task."""

    fine: bool
    task: str
    text: str


def judge(found: Survey, limits: Thresholds) -> list[Finding]:
    """All judgements, task by task."""
    return [finding for task in found.tasks for finding in _task(task, len(found.tasks), limits)]


def summary(findings: Iterable[Finding]) -> str:
    """The verdict in one sentence."""
    doubts = [finding for finding in findings if not finding.fine]
    if not doubts:
        return "worth training on: nothing speaks against it"
    tasks = ", ".join(dict.fromkeys(doubt.task for doubt in doubts))
    return f"train on it with care: {len(doubts)} of the above speak against it ({tasks})"


def _task(task: TaskSurvey, tasks: int, limits: Thresholds) -> Iterator[Finding]:
    for judgement in (_events(task, limits), _outcomes(task, limits), _returns(task, limits)):
        yield from (Finding(fine, task.task, text) for fine, text in judgement)
    for judgement in (_actions(task, limits), _depth(task, limits), _share(task, tasks, limits)):
        yield from (Finding(fine, task.task, text) for fine, text in judgement)


type _Judgement = Iterator[tuple[bool, str]]


def _events(task: TaskSurvey, limits: Thresholds) -> _Judgement:
    rate = 1000.0 * task.moments / task.steps
    have = f"{task.moments} episodes with an event, {rate:.2f} per 1000 steps"
    if task.moments < limits.moments:
        yield False, f"too few events for Q: {have}; at least {limits.moments}: collect more"
    elif rate < limits.moments_per_1000:
        yield (
            False,
            f"too few events for Q: {have}; at least {limits.moments_per_1000}: shorten the "
            "episodes or let the event come sooner",
        )
    else:
        yield True, have
    for kind, count in (("good", task.good_moments), ("bad", task.bad_moments)):
        if not count:
            yield False, f"not a single {kind} event: Q cannot learn what makes one"


def _outcomes(task: TaskSurvey, limits: Thresholds) -> _Judgement:
    share = max(task.success_share, 1.0 - task.success_share)
    have = f"{task.success_share:.0%} of the episodes succeed, {task.fall_share:.0%} fall"
    if share > limits.one_outcome:
        yield (
            False,
            f"one outcome: {have}; nothing to tell apart: make the scenes "
            f"{'harder' if task.success_share > 0.5 else 'easier'}",
        )
    else:
        yield True, have


def _returns(task: TaskSurvey, limits: Thresholds) -> _Judgement:
    r = task.returns
    if r.valid_share < limits.valid_rows or r.spread is None:
        yield (
            False,
            f"only {r.valid_share:.0%} of the rows have a return over {r.steps} ticks; at least "
            f"{limits.valid_rows:.0%}: lengthen the episodes or shorten --returns.steps",
        )
    if r.spread is None:
        return
    have = f"return {r.spread.mean:.3f} +- {r.spread.std:.3f}"
    if r.spread.std < limits.return_std:
        yield False, f"{have}: almost a constant, nothing to learn"
    else:
        yield True, have
    ahead = f"{r.positive_share:.1%} of the rows have a reward ahead that stands out"
    if r.positive_share < limits.good_rows:
        yield False, f"{ahead}; at least {limits.good_rows:.0%}"
    else:
        yield True, f"{ahead}, {r.negative_share:.1%} a cost"


def _actions(task: TaskSurvey, limits: Thresholds) -> _Judgement:
    name, least = min(task.action.uniformity.items(), key=lambda item: item[1])
    hand, filled = min(task.action.occupied.items(), key=lambda item: item[1])
    low = []
    if least < limits.uniformity:
        low.append(f"{name} is uneven ({least:.2f} of 1, at least {limits.uniformity})")
    if filled < limits.occupied:
        low.append(
            f"the {hand} hand was in {filled:.0%} of its cells, at least {limits.occupied:.0%}"
        )
    if low:
        yield False, f"action occupancy low: {'; '.join(low)}"
    else:
        yield True, f"actions fill their box: {filled:.0%} of the cells, evenness {least:.2f} of 1"


def _depth(task: TaskSurvey, limits: Thresholds) -> _Judgement:
    d = task.depth
    if d.valid_share < limits.valid_pixels:
        yield (
            False,
            f"only {d.valid_share:.0%} of the depth pixels were measured, at least "
            f"{limits.valid_pixels:.0%}: is the camera blind?",
        )
    elif d.empty_share > limits.empty_frames:
        yield (
            False,
            f"{d.empty_share:.0%} of the frames are empty, at most {limits.empty_frames:.0%}",
        )
    else:
        yield True, f"{d.valid_share:.0%} of the depth pixels were measured"


def _share(task: TaskSurvey, tasks: int, limits: Thresholds) -> _Judgement:
    if task.step_share * tasks < limits.balance:
        yield (
            False,
            f"only {task.step_share:.0%} of the steps; at least "
            f"{limits.balance / tasks:.0%} of {tasks} tasks: mix in more",
        )
