"""Gradient steps and frames per second on a GPU, beside one thread of the same machine's processor.

Wall-clock times, including the wait for the GPU, for each number of windows:

* ``step``: `egovcp_train.loop.Learner.update` on one batch in the GPU's memory, in the precision
  that ``egovcp-train`` takes there by itself (``bf16`` says which);
* ``float32``: the same in float32;
* ``critic``: ``step`` while the critic is trained too, as in `train_step.py`;
* ``data``: ``step`` with its batch drawn from the stream and copied there, as in training;
* ``cpu``: a step on one thread of the processor, in its own precision (``cpu_bf16``).

The cases take turns, after the steps that are recorded as CUDA graphs (`egovcp.cuda_graphs`).
``peak_memory_4_learners`` is the peak of GPU memory, with the learners of ``step``, ``float32``,
``critic`` and ``data`` in it.

    python benchmarks/train_step_gpu.py --root data/ball
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from report import interleaved, parser, publish
from train_step import CRITIC_TRAINED, add_critic
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
from egovcp_train.config import OptimizerConfig, SamplingConfig
from egovcp_train.datasets import set_normalisation, to_tensors
from egovcp_train.device import choose_bf16
from egovcp_train.loop import Learner

LENGTH = SamplingConfig().length
EPISODES = 100  # of each task
WARM_UP_STEPS = 64  # enough to capture every graph variant (whichever rows are sampled)
CPU, GPU = torch.device("cpu"), torch.device("cuda")


def cases(store: EpisodeStore, size: int, on_cpu: bool) -> dict[str, Callable[[], object]]:
    """Name -> a step that is over when the call returns."""
    model = WorldModel(WorldModelConfig())
    set_normalisation(model, store)
    config = OptimizerConfig(warmup_steps=0)
    stream = InMemorySampler(store, SamplerConfig(batch_size=size, length=LENGTH))

    def learner(device: torch.device, bf16: bool) -> Learner:
        return Learner(copy.deepcopy(model).to(device), config, seed=0, bf16=bf16)

    def batch(device: torch.device) -> Batch:
        return to_tensors(next(stream), device)

    def stepping(
        device: torch.device, bf16: bool, fresh: bool = False, critic: bool = False
    ) -> Callable[[], object]:
        mine, kept = learner(device, bf16), batch(device)
        if critic:
            add_critic(mine, kept)

        def step() -> None:
            mine.update(batch(device) if fresh else kept, CRITIC_TRAINED if critic else 0.0)
            if device.type == "cuda":
                torch.cuda.synchronize()

        for _ in range(WARM_UP_STEPS if device.type == "cuda" else 0):
            step()
        if mine.capture_error:
            raise SystemExit(f"a step cannot be recorded: {mine.capture_error}")
        return step

    own = choose_bf16("auto", GPU)
    found = {
        "step": stepping(GPU, own),
        "float32": stepping(GPU, bf16=False),
        "critic": stepping(GPU, own, critic=True),
        "data": stepping(GPU, own, fresh=True),
    }
    return found | ({"cpu": stepping(CPU, choose_bf16("auto", CPU))} if on_cpu else {})


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--root", type=Path, help="dataset to train on; none: one is made")
    options.add_argument("--batches", type=int, nargs="+", default=[16, 64, 256], help="windows")
    options.add_argument(
        "--cpu_batches", type=int, nargs="*", default=[16], help="of these, also on the processor"
    )
    options.add_argument(
        "--return_steps", type=int, default=ReturnConfig().steps, help="horizon of returns, ticks"
    )
    args = options.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("torch finds no CUDA device here; benchmarks/train_step.py needs none")
    torch.set_num_threads(1)
    out: dict[str, object] = {
        "window": LENGTH,
        "bf16": choose_bf16("auto", GPU),
        "cpu_bf16": choose_bf16("auto", CPU),
    }
    with tempfile.TemporaryDirectory() as folder:
        root = args.root or Path(folder) / "dataset"
        if args.root is None:
            write_dataset(root, [make_episode(i, 150) for i in range(EPISODES)])
        index = EpisodeIndex.of([open_dataset(root)], "train").subsample(EPISODES)
        store = EpisodeStore.read(index, ReturnConfig(steps=args.return_steps))
        for size in args.batches:
            seconds = interleaved(cases(store, size, size in args.cpu_batches), args.rounds)
            for name, value in seconds.items():
                out[f"{name}_{size}_ms"] = 1e3 * value
            out[f"steps_{size}_per_s"] = 1 / seconds["data"]
            out[f"frames_{size}_per_s"] = size * LENGTH / seconds["data"]
            if "cpu" in seconds:
                out[f"cpu_ratio_{size}"] = seconds["cpu"] / seconds["step"]
            out[f"peak_memory_4_learners_{size}_gb"] = torch.cuda.max_memory_allocated() / 1e9
            torch.cuda.reset_peak_memory_stats()
    publish(out, args.json)


if __name__ == "__main__":
    main()
