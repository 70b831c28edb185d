"""Gradient steps per second, against a plain eager implementation and on data that is ready.

* ``step``: `egovcp_train.loop.Learner.update`, forward to averaged weights, on one batch in memory,
  in the precision that ``egovcp-train`` takes here by itself (``bf16`` says which);
* ``float32``: the same in float32;
* ``plain``: the same mathematics in plain eager fp32 (`plain_step.py`): the same weights, batch
  and random draws, and, before anything is measured, the same loss as ``float32``;
* ``data``: a step with its batch drawn from the stream and made into tensors, as in training.

The cases take turns; ratios are medians of the ratios of one turn. Processor time counts, so that
other programs on the machine do not; with several threads that is the time of all of them, and the
rates, which are by the clock, want a quiet machine.

    python benchmarks/train_step.py --root data/ball
"""

from __future__ import annotations

import copy
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from plain_step import PlainLearner
from report import parser, publish
from writer import make_episode
from writer import writer as write

from egovcp.data import EpisodeIndex, EpisodeStore, SequenceStream, StreamConfig, open_dataset
from egovcp.model import Batch, WorldModel, WorldModelConfig
from egovcp_train.batches import set_normalisation, to_tensors
from egovcp_train.config import OptimizerConfig, SamplingConfig
from egovcp_train.device import choose_bf16
from egovcp_train.labels.config import PassingConfig
from egovcp_train.labels.passing import label
from egovcp_train.loop import Learner

TOLERANCE = 1e-4  # of the loss, relative: sums of some million fp32 numbers in another order
LENGTH = SamplingConfig().length
EPISODES = 100  # of each task
CPU = torch.device("cpu")
BF16 = choose_bf16("auto", CPU)

type Turn = dict[str, tuple[float, float]]


class Case:
    """One batch size: both learners, and the stream."""

    def __init__(self, store: EpisodeStore, batch: int) -> None:
        torch.manual_seed(0)
        model = WorldModel(WorldModelConfig())
        set_normalisation(model, store)
        config = OptimizerConfig(warmup_steps=0)
        self.stream = SequenceStream(store, StreamConfig(batch_size=batch, length=LENGTH))
        self.batch = self._next()
        self.plain = PlainLearner(model, config, seed=0)
        self.ours = Learner(copy.deepcopy(model), config, seed=0, bf16=BF16)
        self.float32 = Learner(model, config, seed=0)
        self._compare()

    def _next(self) -> Batch:
        return to_tensors(next(self.stream), CPU)

    def _compare(self) -> None:
        """The first step warms all up, and has to find the same loss."""
        self.ours.update(self.batch, 0.0)
        ours = float(self.float32.update(self.batch, 0.0)["loss/total"])
        plain = self.plain.update(self.batch)
        self.difference = abs(ours - plain) / abs(plain)
        if self.difference > TOLERANCE:
            raise SystemExit(f"not the same mathematics: loss {ours}, plain {plain}")

    def turn(self) -> Turn:
        """Seconds of the processor and of the clock of each case, and of getting a batch."""
        wait = (0.0, 0.0)

        def on_data() -> None:
            nonlocal wait
            wait = timed(lambda: fetched.append(self._next()))
            self.ours.update(fetched.pop(), 0.0)

        fetched: list[Batch] = []
        cases: dict[str, Callable[[], object]] = {
            "plain": lambda: self.plain.update(self.batch),
            "float32": lambda: self.float32.update(self.batch, 0.0),
            "step": lambda: self.ours.update(self.batch, 0.0),
            "data": on_data,
        }
        found = {name: timed(case) for name, case in cases.items()}
        return found | {"wait": wait}


def timed(case: Callable[[], object]) -> tuple[float, float]:
    """Seconds of the processor, and of the clock."""
    cpu, clock = time.process_time(), time.perf_counter()
    case()
    return time.process_time() - cpu, time.perf_counter() - clock


def figures(turns: list[Turn], name: str, frames: int) -> dict[str, object]:
    """What the turns of one case come to; keys begin with ``name``."""

    def ratio(a: str, b: str) -> float:
        return statistics.median(turn[a][0] / turn[b][0] for turn in turns)

    cpu = {key: statistics.median(turn[key][0] for turn in turns) for key in turns[0]}
    clock = statistics.median(turn["data"][1] for turn in turns)
    return {
        f"{name}_cpu_ms": 1e3 * cpu["step"],
        f"{name}_float32_cpu_ms": 1e3 * cpu["float32"],
        f"{name}_plain_cpu_ms": 1e3 * cpu["plain"],
        f"{name}_ratio": ratio("plain", "step"),
        f"{name}_float32_ratio": ratio("plain", "float32"),
        f"{name}_data_ratio": ratio("data", "step"),
        f"{name}_wait_share": ratio("wait", "data"),
        f"{name}_steps_per_s": 1.0 / clock,
        f"{name}_frames_per_s": frames / clock,
        f"{name}_steps_per_cpu_s": 1.0 / cpu["data"],
        f"{name}_frames_per_cpu_s": frames / cpu["data"],
    }


def measure(root: Path, batches: list[int], threads: list[int], rounds: int) -> dict[str, object]:
    """All figures; keys say the batch and the number of threads."""
    index = EpisodeIndex.of([open_dataset(root)], "train").spread(EPISODES)
    store = label(EpisodeStore.read(index), PassingConfig())
    out: dict[str, object] = {"window": LENGTH, "bf16": BF16}
    for size in batches:
        for count in threads:
            torch.set_num_threads(count)
            case = Case(store, size)
            turns = [case.turn() for _ in range(rounds)]
            name = f"step_{size}_threads_{count}"
            out |= figures(turns, name, size * LENGTH)
            out[f"{name}_loss_difference"] = case.difference
    return out


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--root", type=Path, help="dataset to train on; none: one is made")
    options.add_argument("--batches", type=int, nargs="+", default=[16, 32], help="windows")
    options.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="CPU threads")
    args = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = args.root or Path(folder) / "dataset"
        if args.root is None:
            write(root, [make_episode(i, 150) for i in range(100)])
        publish(measure(root, args.batches, args.threads, args.rounds), args.json)


if __name__ == "__main__":
    main()
