"""Gradient steps per second, against a plain eager implementation and on data that is ready.

* ``step``: `egovcp_train.loop.Learner.update`, forward to averaged weights, on one batch in memory,
  in the default precision of ``egovcp-train`` on this machine (see ``bf16``), and in a process that
  keeps freed memory, as ``egovcp-train`` does;
* ``float32``: the same in float32;
* ``plain``: the same mathematics in plain eager fp32 (`plain_step.py`), in a process as Python
  starts it: the same weights, batch and random draws, and, before anything is measured, the same
  loss as ``float32``;
* ``critic``: ``step`` while the critic is trained too and Q is fitted to it, the default of
  ``egovcp-train`` where the data has positions of objects; the others fit Q to returns;
* ``data``: a step with its batch drawn from the stream and made into tensors, as in training.

The cases take turns; ratios are medians of the ratios of one turn. Processor time counts, so that
other programs do not matter; with several threads it is the time of all of them, including waits
for each other. ``clock_ratio`` and the rates are wall-clock times and need an idle machine.

    python benchmarks/train_step.py --root data/ball
"""

from __future__ import annotations

import copy
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from plain_step import PlainLearner
from report import parser, publish
from writer import make_episode, write_dataset

from egovcp.data import (
    EpisodeIndex,
    EpisodeStore,
    InMemorySampler,
    ReturnConfig,
    SamplerConfig,
    open_dataset,
)
from egovcp.model import Batch, WorldModel, WorldModelConfig
from egovcp.model.privileged_value import PrivilegedValue
from egovcp_train.config import OptimizerConfig, SamplingConfig
from egovcp_train.datasets import set_normalisation, to_tensors
from egovcp_train.device import choose_bf16, keep_freed_memory
from egovcp_train.loop import Learner
from egovcp_train.privileged_value import Critic

TOLERANCE = 1e-4  # of the loss, relative: sums of some million fp32 numbers in another order
LENGTH = SamplingConfig().length
EPISODES = 100  # of each task
CRITIC_TRAINED = 0.5  # progress of a run at which the critic is trained as well
CPU = torch.device("cpu")
BF16 = choose_bf16("auto", CPU)

type Side = Literal["ours", "plain"]
type Times = dict[str, tuple[float, float]]


def add_critic(learner: Learner, batch: Batch) -> Learner:
    """Let ``learner`` train a critic too; ``batch`` has the shapes and the device of the data."""
    value = PrivilegedValue(batch.privileged.shape[-1]).to(batch.privileged.device)
    lr = learner.config.privileged_value.training_lr
    learner.critic = Critic(value, learner.planner, lr)
    return learner


class Learners:
    """What one process measures: our steps and the stream, or the plain step."""

    def __init__(
        self, side: Side, root: Path, returns: ReturnConfig, size: int, threads: int
    ) -> None:
        if side == "ours":
            keep_freed_memory()
        torch.set_num_threads(threads)
        torch.manual_seed(0)
        index = EpisodeIndex.of([open_dataset(root)], "train").subsample(EPISODES)
        store = EpisodeStore.read(index, returns)
        self._model = WorldModel(WorldModelConfig())
        set_normalisation(self._model, store)
        self._config = OptimizerConfig(warmup_steps=0)
        self._stream = InMemorySampler(store, SamplerConfig(batch_size=size, length=LENGTH))
        self._batch = self._next()

    def _next(self) -> Batch:
        return to_tensors(next(self._stream), CPU)

    @cached_property
    def _plain(self) -> PlainLearner:
        return PlainLearner(self._model, self._config, seed=0)

    @cached_property
    def _float32(self) -> Learner:
        return Learner(copy.deepcopy(self._model), self._config, seed=0)

    @cached_property
    def _ours(self) -> Learner:
        return Learner(copy.deepcopy(self._model), self._config, seed=0, bf16=BF16)

    @cached_property
    def _with_critic(self) -> Learner:
        learner = Learner(copy.deepcopy(self._model), self._config, seed=0, bf16=BF16)
        return add_critic(learner, self._batch)

    def first(self, side: Side) -> float:
        """Warm up every case with one step; returns its float32 loss."""
        if side == "plain":
            return self._plain.update(self._batch)
        self._ours.update(self._batch, 0.0)
        self._with_critic.update(self._batch, CRITIC_TRAINED)
        return float(self._float32.update(self._batch, 0.0)["loss/total"])

    def turn(self, side: Side) -> Times:
        """Seconds of the processor and of the clock of each case, and of getting a batch."""
        if side == "plain":
            return {"plain": timed(lambda: self._plain.update(self._batch))}
        fetched: list[Batch] = []
        batch = (0.0, 0.0)

        def on_data() -> None:
            nonlocal batch
            batch = timed(lambda: fetched.append(self._next()))
            self._ours.update(fetched.pop(), 0.0)

        cases: dict[str, Callable[[], object]] = {
            "float32": lambda: self._float32.update(self._batch, 0.0),
            "step": lambda: self._ours.update(self._batch, 0.0),
            "critic": lambda: self._with_critic.update(self._batch, CRITIC_TRAINED),
            "data": on_data,
        }
        return {name: timed(step) for name, step in cases.items()} | {"batch": batch}


_learners: list[Learners] = []  # of a process of `take_turns`


def _begin(side: Side, root: Path, returns: ReturnConfig, size: int, threads: int) -> None:
    _learners.append(Learners(side, root, returns, size, threads))


def _first(side: Side) -> float:
    return _learners[0].first(side)


def _turn(side: Side) -> Times:
    return _learners[0].turn(side)


def take_turns(
    root: Path, returns: ReturnConfig, size: int, threads: int, rounds: int
) -> tuple[list[Times], float]:
    """Turns of both sides, each in its own process, one at a time; how far their losses differ."""
    spawn = multiprocessing.get_context("spawn")
    sides: Mapping[Side, ProcessPoolExecutor] = {
        side: ProcessPoolExecutor(1, spawn, _begin, (side, root, returns, size, threads))
        for side in ("plain", "ours")
    }
    try:
        plain, ours = (pool.submit(_first, side).result() for side, pool in sides.items())
        difference = abs(ours - plain) / abs(plain)
        if difference > TOLERANCE:
            raise SystemExit(f"not the same mathematics: loss {ours}, plain {plain}")
        turns = []
        for _ in range(rounds):
            parts = [pool.submit(_turn, side).result() for side, pool in sides.items()]
            turns.append(parts[0] | parts[1])
        return turns, difference
    finally:
        for pool in sides.values():
            pool.shutdown()


def timed(step: Callable[[], object]) -> tuple[float, float]:
    """Seconds of the processor, and of the clock."""
    cpu, clock = time.process_time(), time.perf_counter()
    step()
    return time.process_time() - cpu, time.perf_counter() - clock


def metrics(turns: list[Times], name: str, frames: int) -> dict[str, object]:
    """Metrics of one case; keys begin with ``name``."""

    def ratio(a: str, b: str, of: int = 0) -> float:
        return statistics.median(turn[a][of] / turn[b][of] for turn in turns)

    cpu = {key: statistics.median(turn[key][0] for turn in turns) for key in turns[0]}
    clock = statistics.median(turn["data"][1] for turn in turns)
    return {
        f"{name}_cpu_ms": 1e3 * cpu["step"],
        f"{name}_float32_cpu_ms": 1e3 * cpu["float32"],
        f"{name}_plain_cpu_ms": 1e3 * cpu["plain"],
        f"{name}_ratio": ratio("plain", "step"),
        f"{name}_clock_ratio": ratio("plain", "step", of=1),
        f"{name}_float32_ratio": ratio("plain", "float32"),
        f"{name}_critic_ratio": ratio("critic", "step"),
        f"{name}_data_ratio": ratio("data", "step"),
        f"{name}_batch_share": ratio("batch", "data"),
        f"{name}_steps_per_s": 1.0 / clock,
        f"{name}_frames_per_s": frames / clock,
        f"{name}_steps_per_cpu_s": 1.0 / cpu["data"],
        f"{name}_frames_per_cpu_s": frames / cpu["data"],
    }


def measure(
    root: Path, returns: ReturnConfig, batches: list[int], threads: list[int], rounds: int
) -> dict[str, object]:
    """All metrics; keys say the batch and the number of threads."""
    out: dict[str, object] = {"window": LENGTH, "bf16": BF16}
    for size in batches:
        for count in threads:
            turns, difference = take_turns(root, returns, size, count, rounds)
            name = f"step_{size}_threads_{count}"
            out |= metrics(turns, name, size * LENGTH)
            out[f"{name}_loss_difference"] = difference
    return out


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--root", type=Path, help="dataset to train on; none: one is made")
    options.add_argument("--batches", type=int, nargs="+", default=[16, 32], help="windows")
    options.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="CPU threads")
    options.add_argument(
        "--return_steps", type=int, default=ReturnConfig().steps, help="horizon of returns, ticks"
    )
    args = options.parse_args()
    returns = ReturnConfig(steps=args.return_steps)
    with tempfile.TemporaryDirectory() as folder:
        root = args.root or Path(folder) / "dataset"
        if args.root is None:
            write_dataset(root, [make_episode(i, 150) for i in range(EPISODES)])
        publish(measure(root, returns, args.batches, args.threads, args.rounds), args.json)


if __name__ == "__main__":
    main()
