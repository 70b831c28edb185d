"""How much of the Monte Carlo return is there to be known, and how much of it Q knows.

Simulates the episodes of datasets again to learn the true state at each row, regresses the return
on it by small networks (training episodes only), and judges the best of them on the held-out
episodes; beside it, on the very same rows, the Q of trained policies. A row per task and policy:

    python benchmarks/reachable.py --dataset.root=data/ball --output_dir=outputs/reachable \
      --policy.path=RUN/checkpoints/last/pretrained_model --json=reachable.json

Without a policy it says what is reachable for the horizons --horizons. The true states are kept in
the output folder. docs/world_model.md explains the figures.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from probe import Data, Guess, ProbeConfig, explained, probe
from probe_inputs import SETS, blocks, mirrored
from report import publish
from true_state import Array, Columns, true_states

from egovcp import spec
from egovcp.artifact import Artifact, load_artifact, returns_of
from egovcp.cli import SelectedDatasetConfig, run_command
from egovcp.data import DatasetReader, EpisodeStore, ReturnConfig
from egovcp.data.index import EpisodeIndex, in_split, require_mixable
from egovcp.data.returns import mc_return, mc_valid
from egovcp.data.store import gather
from egovcp.errors import DataError, UsageError
from egovcp.model.losses import filter_sequence
from egovcp.policy_options import PolicyOptions
from egovcp_train.datasets import to_tensors
from egovcp_train.heldout.command import require_same_controller
from egovcp_train.heldout.report import calibration

PROG = "reachable.py"
VALIDATION = 0.16  # hashes below it are not learned from; held out are those below 0.05
RESAMPLES = 1000
AT_ONCE = 32  # episodes that are filtered together


@dataclass(frozen=True)
class ReachableConfig:
    """Share of the return's variance that a regression on true state explains, and that Q does."""

    output_dir: str
    """Folder that keeps the true states."""
    dataset: SelectedDatasetConfig = field(default_factory=SelectedDatasetConfig)
    """Dataset with the episodes."""
    datasets: tuple[SelectedDatasetConfig, ...] = ()
    """Several datasets instead, '[{root: data/ball}, {root: data/wall}]'."""
    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """Policy whose Q is judged, too."""
    policies: tuple[str, ...] = ()
    """Further policies, '[RUN_A, RUN_B]'."""
    episodes: int = 0
    """At most so many training episodes of each task, evenly spread; 0: all. Held-out ones: all."""
    horizons: tuple[int, ...] = (spec.RETURN_STEPS, 50)
    """Ticks K of the return where no policy says how its own was made."""
    gamma: float = spec.GAMMA
    """Discount where no policy says."""
    probe: ProbeConfig = field(default_factory=ProbeConfig)
    """Fit of the regressions."""
    threads: int = 1
    """CPU threads."""
    json: str = ""
    """File for the figures; empty: none."""


class Episodes(NamedTuple):
    """Some episodes of one task, their rows one after the other."""

    columns: Columns
    length: NDArray[np.int64]
    time_limit: tuple[int, ...]
    identities: tuple[str, ...]

    def some(self, chosen: NDArray[np.bool_]) -> Episodes:
        """The episodes (E,) that are true."""
        rows = np.repeat(chosen, self.length)
        pick = np.flatnonzero(chosen).tolist()
        return Episodes(
            {name: column[rows] for name, column in self.columns.items()},
            self.length[chosen],
            tuple(self.time_limit[i] for i in pick),
            tuple(self.identities[i] for i in pick),
        )

    def returns(self, config: ReturnConfig) -> tuple[Array, NDArray[np.bool_]]:
        """(N,) returns, and which of them are complete."""
        reward = np.split(self.columns["reward"][:, 0], np.cumsum(self.length)[:-1])
        limits = zip(self.length.tolist(), self.time_limit, strict=True)
        return (
            np.concatenate([mc_return(r, config.gamma, config.steps) for r in reward]),
            np.concatenate([mc_valid(n, limit, config.steps) for n, limit in limits]),
        )


class Case(NamedTuple):
    """A return to be explained, and who claims to know it."""

    label: str
    returns: ReturnConfig
    artifact: Artifact | None = None


class Outcome(NamedTuple):
    """One row of the table."""

    task: str
    label: str
    episodes: int
    guess: Guess
    reachable: float
    """R^2 of the probe on held-out rows."""
    reachable_range: tuple[float, float]
    """95 %, episodes drawn again."""
    value: dict[str, float | int | None]
    """Calibration of Q, see `calibration`; empty without a policy."""
    ratio_range: tuple[float, float] | None

    @property
    def ratio(self) -> float | None:
        """R^2 of Q over that of the probe."""
        r2 = self.value.get("r2")
        return None if r2 is None or self.reachable <= 0 else r2 / self.reachable


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(ReachableConfig, measure, argv, prog=PROG)


def measure(config: ReachableConfig) -> None:
    """Measure, print the table, write the JSON."""
    if config.episodes < 0:
        raise UsageError(f"--episodes={config.episodes}: expected at least 0")
    torch.set_num_threads(config.threads)
    readers = [DatasetReader.open(d) for d in config.datasets or (config.dataset,)]
    require_mixable(readers)
    chosen = _cases(config, readers)
    outcomes = [o for task in _Tasks(config, readers) for o in task.outcomes(chosen)]
    print(_table(outcomes))
    publish(_figures(outcomes), Path(config.json) if config.json else None)


def _cases(config: ReachableConfig, readers: Sequence[DatasetReader]) -> list[Case]:
    """Each policy with its own return, or each horizon."""
    paths = [config.policy.path] if config.policy.path else []
    found = []
    for number, path in enumerate([*paths, *config.policies], start=1):
        artifact = load_artifact(path, config.policy.revision if number == 1 else "")
        for reader in readers:
            require_same_controller(artifact, reader)
        returns = replace(returns_of(artifact), keep_truncated=False)
        found.append(Case(f"policy{number}", returns, artifact))
    if not found:
        found = [Case(f"k{k}", ReturnConfig(config.gamma, k)) for k in config.horizons]
    return [found[0]._replace(label="")] if len(found) == 1 else found


class _Tasks:
    """The tasks of the datasets, one after the other."""

    def __init__(self, config: ReachableConfig, readers: Sequence[DatasetReader]) -> None:
        self._config = config
        self._readers = readers

    def __iter__(self) -> Iterator[_Task]:
        splits = {s: EpisodeIndex.of(self._readers, s) for s in ("train", "heldout")}
        for task in spec.TASKS:
            own = {s: index.select(_of(task, index)) for s, index in splits.items()}
            if all(len(index) for index in own.values()):
                yield self._task(task, own["train"], own["heldout"])

    def _task(self, task: str, train: EpisodeIndex, heldout: EpisodeIndex) -> _Task:
        config = self._config
        if config.episodes:
            train = train.subsample(config.episodes)
        folder = Path(config.output_dir)
        learning, judging = (episodes_of(index, folder) for index in (train, heldout))
        return _Task(task, learning, judging, heldout, config.probe)


def _of(task: str, index: EpisodeIndex) -> NDArray[np.int64]:
    return np.flatnonzero(np.array(index.tasks) == task)


def episodes_of(index: EpisodeIndex, folder: Path) -> Episodes:
    """The episodes of one task with their true states, which are kept in ``folder``."""
    parts, limits = [], []
    for d, reader in enumerate(index.readers):
        numbers = index.number[index.dataset == d].tolist()
        if numbers:
            parts.append(true_states(reader, numbers, folder))
            limits += [reader.time_limit(i) for i in numbers]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Episodes(columns, index.length, tuple(limits), index.identities)


class _Task:
    """What is known of one task, and what can be."""

    def __init__(
        self,
        name: str,
        learning: Episodes,
        judging: Episodes,
        heldout: EpisodeIndex,
        config: ProbeConfig,
    ) -> None:
        self.name = name
        self._judging, self._heldout, self._config = judging, heldout, config
        validation = np.array(in_split(learning.identities, "heldout", VALIDATION))
        if not 0 < validation.sum() < len(validation):
            raise DataError(f"{name}: {len(validation)} training episodes do not make a probe")
        self._fit, self._validation = learning.some(~validation), learning.some(validation)
        self._guesses: dict[tuple[float, int], Guess] = {}

    def outcomes(self, cases: Sequence[Case]) -> Iterator[Outcome]:
        """One per case."""
        for case in cases:
            yield self._outcome(case)

    def _outcome(self, case: Case) -> Outcome:
        guess = self._guess(case.returns)
        target, valid = self._judging.returns(case.returns)
        target = target[valid]
        said = {"probe": guess.value}
        scores: dict[str, float | int | None] = {}
        if case.artifact is not None:
            said["value"] = values(case.artifact, self._heldout, case.returns)
            q = torch.from_numpy(said["value"])
            scores = calibration(q, torch.from_numpy(target))
        episode = np.repeat(np.arange(len(self._judging.length)), self._judging.length)[valid]
        drawn = redrawn(said, target, episode)
        ratio = drawn["value"] / drawn["probe"] if "value" in drawn else None
        return Outcome(
            self.name,
            case.label,
            len(self._judging.length),
            guess,
            explained(guess.value, target),
            _range(drawn["probe"]),
            scores,
            None if ratio is None else _range(ratio),
        )

    def _guess(self, returns: ReturnConfig) -> Guess:
        """The probe of a return; found once."""
        key = (returns.gamma, returns.steps)
        if key not in self._guesses:
            fit, validation, judged = (
                _data(self.name, part, returns, mirror=part is self._fit)
                for part in (self._fit, self._validation, self._judging)
            )
            self._guesses[key] = probe(fit, validation, judged, self._config)
        return self._guesses[key]


def _data(task: str, episodes: Episodes, returns: ReturnConfig, mirror: bool) -> Data:
    """Inputs and target of the rows whose return is complete."""
    target, valid = episodes.returns(returns)
    columns = {name: column[valid] for name, column in episodes.columns.items()}
    other = _inputs(task, mirrored(columns)) if mirror else None
    return Data(_inputs(task, columns), target[valid], other)


def _inputs(task: str, columns: Columns) -> dict[str, Array]:
    parts = blocks(task, columns)
    return {
        name: np.concatenate([parts[block] for block in chosen], axis=1)
        for name, chosen in SETS.items()
    }


@torch.no_grad()
def values(artifact: Artifact, heldout: EpisodeIndex, returns: ReturnConfig) -> Array:
    """Q of the recorded actions on the rows whose return is complete, episodes filtered from
    their start as on the robot."""
    model = artifact.world_model.eval()
    store, found = EpisodeStore.read(heldout, returns), []
    for which in np.split(np.arange(len(store.length)), range(AT_ONCE, len(store.length), AT_ONCE)):
        arrays = gather(store, store.start[which], which, int(store.length[which].max()))
        batch = to_tensors(arrays, torch.device("cpu"))
        carry = filter_sequence(model, batch, sample=False).carry
        found.append(model.value(carry, batch.action)[batch.valid & batch.mc_valid])
    return np.asarray(torch.cat(found).numpy())


def redrawn(
    said: dict[str, Array], target: Array, episode: NDArray[np.int64]
) -> dict[str, NDArray[np.float64]]:
    """R^2 of each guess for `RESAMPLES` draws of as many episodes as there are."""
    count = int(episode.max()) + 1
    rng = np.random.default_rng(0)
    weight = rng.multinomial(count, np.full(count, 1 / count), size=RESAMPLES)

    def summed(per_row: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.asarray(weight @ np.bincount(episode, per_row.astype(np.float64), count), float)

    rows, total, square = summed(np.ones(len(target))), summed(target), summed(target**2)
    spread = np.maximum(square - total**2 / rows, 1e-12)
    return {name: 1 - summed((guess - target) ** 2) / spread for name, guess in said.items()}


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.quantile(values, [0.025, 0.975]).tolist()
    return low, high


def _table(outcomes: Sequence[Outcome]) -> str:
    head = ("task", "case", "episodes", "reachable R2", "95 %", "Q R2", "slope", "bias", "Q/reach.")
    lines: list[tuple[str, ...]] = [head]
    for o in outcomes:
        value = [o.value.get(name) for name in ("r2", "slope", "bias")]
        lines.append(
            (
                o.task,
                o.label or "-",
                str(o.episodes),
                f"{o.reachable:.3f}",
                "{:.2f}-{:.2f}".format(*o.reachable_range),
                *("-" if v is None else f"{v:.3f}" for v in value),
                "-" if o.ratio is None else f"{o.ratio:.2f}",
            )
        )
    return "\n".join("  ".join(f"{cell:>12}" for cell in line) for line in lines)


def _figures(outcomes: Sequence[Outcome]) -> dict[str, object]:
    """Flat keys, ``ball_q_over_reachable_ratio``; with several cases ``ball_k16_..``."""
    figures: dict[str, object] = {}
    for o in outcomes:
        found = {
            "heldout_episodes": o.episodes,
            "reachable_rows": len(o.guess.value),
            "reachable_r2": o.reachable,
            "reachable_r2_low": o.reachable_range[0],
            "reachable_r2_high": o.reachable_range[1],
            "reachable_validation_r2": o.guess.r2,
            "reachable_inputs": o.guess.name,
            **{f"q_{name}": value for name, value in o.value.items()},
        }
        if o.ratio_range is not None:
            low, high = o.ratio_range
            found |= {"q_over_reachable_ratio": o.ratio, "q_over_reachable_low": low}
            found["q_over_reachable_high"] = high
        prefix = "_".join(filter(None, (o.task, o.label)))
        figures |= {f"{prefix}_{name}": value for name, value in found.items()}
    return figures


if __name__ == "__main__":
    sys.exit(main())
