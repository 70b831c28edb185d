"""What a dataset covers: how often things happen, what they are worth, what was tried.

An *event row* is one whose reward stands out: it differs from the task's median reward by
more than ``JUMP``. Rewards are stored per row, their terms only as sums per episode.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.data import DatasetReader, ReturnConfig
from egovcp_collect.dataset.occupancy import Occupancy
from egovcp_collect.dataset.rows import TaskRows, read_rows
from egovcp_collect.dataset.sample import DepthFacts, Sample, take_sample
from egovcp_collect.dataset.spread import Spread

JUMP: Final = 0.025  # a braced tick earns 0.03, a blocked ball or a passed arch 1
#: Reward terms that say that the task's moment came: well or badly.
GOOD_TERMS: Final = {"ball": ("block",), "wall": ("brace",), "arch": ("pass",)}
BAD_TERMS: Final = {
    "ball": ("hit", "fall"),
    "wall": ("contact", "fall"),
    "arch": ("head", "contact", "fall"),
}


@dataclass(frozen=True)
class EventRate:
    """How often something happened."""

    ticks: int
    """Planner ticks in which it did."""
    per_1000_steps: float
    episodes: int
    """Episodes in which it did."""
    episode_share: float
    """Share of all episodes of the task."""


@dataclass(frozen=True)
class Returns:
    """Monte Carlo returns of the rows that have one."""

    gamma: float
    steps: int
    """Horizon K, planner ticks."""
    valid_share: float
    """Share of rows whose return the time limit does not cut short."""
    spread: Spread | None
    """None where no row has one."""
    positive_share: float
    """Share of those rows with an event row above the median within the horizon."""
    negative_share: float
    """The same, below the median."""


@dataclass(frozen=True)
class TaskSurvey:
    """What the episodes of one task cover."""

    task: str
    episodes: int
    steps: int
    step_share: float
    """Share of the dataset's steps."""
    length: Spread | None
    """Ticks per episode."""
    success_share: float
    """Share of episodes that ended with the task achieved."""
    fall_share: float
    """Share of episodes that a fall ended."""
    moments: int
    """Episodes in which a reward term of the task's moment acted (`GOOD_TERMS`, `BAD_TERMS`)."""
    good_moments: int
    """Those in which a good one did."""
    bad_moments: int
    """Those in which a bad one did."""
    events: dict[str, EventRate]
    """Reward term, or ``touch.hands`` and ``touch.other`` (ticks of contact with the task's
    object, where they were recorded) -> rate."""
    reward: Spread | None
    returns: Returns
    action: Occupancy
    scene: dict[str, Spread]
    """Drawn parameter -> what was drawn."""
    depth: DepthFacts
    """From a sample of episodes."""
    palms_m: dict[str, tuple[float, float]]
    """``left.x`` and so on -> 1 % and 99 % quantile of the measured palms, m, from the sample."""


@dataclass(frozen=True)
class Survey:
    """A dataset's coverage, and what its pictures are drawn from."""

    tasks: tuple[TaskSurvey, ...]
    rows: tuple[TaskRows, ...]
    samples: tuple[Sample, ...]

    def to_json(self) -> dict[str, Any]:
        """The figures, JSON-compatible, by task."""
        return {task.task: asdict(task) for task in self.tasks}


def survey(reader: DatasetReader, returns: ReturnConfig) -> Survey:
    """Survey a dataset: its columns, and the depth of a sample.

    Raises:
        DataError: a file is damaged.
    """
    rows = read_rows(reader, returns)
    samples = [take_sample(reader, task) for task in rows]
    steps = reader.num_frames
    tasks = [_task(r, s, returns, steps) for r, s in zip(rows, samples, strict=True)]
    return Survey(tuple(tasks), tuple(rows), tuple(samples))


def _task(rows: TaskRows, sample: Sample, returns: ReturnConfig, steps: int) -> TaskSurvey:
    good = _episodes_with(rows, GOOD_TERMS[rows.task])
    bad = _episodes_with(rows, BAD_TERMS[rows.task])
    return TaskSurvey(
        task=rows.task,
        episodes=len(rows.length),
        steps=len(rows.reward),
        step_share=len(rows.reward) / steps,
        length=Spread.of(rows.length),
        success_share=float(rows.success.mean()),
        fall_share=float(rows.fallen.mean()),
        moments=int((good | bad).sum()),
        good_moments=int(good.sum()),
        bad_moments=int(bad.sum()),
        events=event_rates(rows),
        reward=Spread.of(rows.reward),
        returns=_returns(rows, returns),
        action=Occupancy.of(rows.action),
        scene=drawn(rows.metadata),
        depth=sample.depth,
        palms_m=_palms(sample.palms_b),
    )


def _ticks(metadata: Mapping[str, Any]) -> dict[str, int]:
    """In how many ticks of an episode each reward term acted, and each contact lasted."""
    terms = metadata.get("reward_terms", {})
    touches = metadata.get("contact_ticks", {})
    return {name: int(term["ticks"]) for name, term in terms.items()} | {
        f"touch.{part}": int(ticks) for part, ticks in touches.items()
    }


def _episodes_with(rows: TaskRows, terms: Sequence[str]) -> NDArray[np.bool_]:
    """(E,) whether any of the reward terms acted."""
    ticks = [_ticks(facts) for facts in rows.metadata]
    return np.array([any(t.get(name, 0) for name in terms) for t in ticks])


def event_rates(rows: TaskRows) -> dict[str, EventRate]:
    """How often each reward term acted and each recorded contact lasted."""
    ticks = [_ticks(facts) for facts in rows.metadata]
    names = dict.fromkeys(name for episode in ticks for name in episode)
    return {name: _rate([t.get(name, 0) for t in ticks], len(rows.reward)) for name in names}


def _rate(ticks: Sequence[int], steps: int) -> EventRate:
    happened = sum(t > 0 for t in ticks)
    return EventRate(sum(ticks), 1000.0 * sum(ticks) / steps, happened, happened / len(ticks))


def _returns(rows: TaskRows, config: ReturnConfig) -> Returns:
    valid = rows.mc_valid
    good, bad = events_ahead(rows, config.steps)
    return Returns(
        gamma=config.gamma,
        steps=config.steps,
        valid_share=float(valid.mean()),
        spread=Spread.of(rows.mc_return[valid]),
        positive_share=float(good[valid].mean()) if valid.any() else 0.0,
        negative_share=float(bad[valid].mean()) if valid.any() else 0.0,
    )


def events_ahead(rows: TaskRows, steps: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N,) and (N,): whether an event row above, or below, the median comes within ``steps``
    rows, counting the row itself, before the episode's end."""
    jump = rows.reward - np.median(rows.reward)
    return _ahead(rows, jump > JUMP, steps), _ahead(rows, jump < -JUMP, steps)


def _ahead(rows: TaskRows, event: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    before = np.concatenate([[0], event.cumsum()])
    end = np.repeat(rows.start + rows.length, rows.length)
    here = np.arange(len(event))
    found: NDArray[np.bool_] = before[np.minimum(here + steps, end)] > before[here]
    return found


def drawn(metadata: Sequence[Mapping[str, Any]]) -> dict[str, Spread]:
    """What was drawn for each scene and randomisation parameter, by its dotted name."""
    values: dict[str, list[float]] = {}
    for facts in metadata:
        for name, value in _parameters(facts):
            values.setdefault(name, []).append(value)
    spreads = {name: Spread.of(np.array(found)) for name, found in values.items()}
    return {name: spread for name, spread in spreads.items() if spread is not None}


_NO_PARAMETERS: Final = ("seed", "episode", "reward_terms", "contact_ticks")


def _parameters(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    for name, value in facts.items():
        if isinstance(value, Mapping):
            if name not in _NO_PARAMETERS:
                yield from _parameters(value, f"{prefix}{name}.")
        elif isinstance(value, int | float) and name not in _NO_PARAMETERS:
            yield f"{prefix}{name}", float(value)


def _palms(palms_b: NDArray[np.float32]) -> dict[str, tuple[float, float]]:
    low, high = np.quantile(palms_b, (0.01, 0.99), axis=0)  # (2, 3) each
    return {
        f"{hand}.{axis}": (float(low[h, a]), float(high[h, a]))
        for h, hand in enumerate(("left", "right"))
        for a, axis in enumerate("xyz")
    }
