"""What a run trains on: which datasets, how often each is drawn, in memory or from the disk."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.cli import DatasetConfig, SelectedDatasetConfig
from egovcp.data import (
    DatasetReader,
    EpisodeIndex,
    EpisodeStore,
    InMemorySampler,
    Mix,
    SamplerConfig,
    StreamingSampler,
    compute_training_stats,
    estimate_training_stats,
    sample_files,
)
from egovcp.data.samplers import PrefetchIterator
from egovcp.data.schema import INFO_PATH
from egovcp.data.source import is_local, local_root
from egovcp.errors import DataError, UsageError
from egovcp.hardware import available_bytes
from egovcp.model import WorldModel
from egovcp_train.batches import fix_normalisation, set_normalisation
from egovcp_train.config import TrainConfig
from egovcp_train.output import CONFIG_FILE
from egovcp_train.ranks import ALONE, Ranks
from egovcp_train.return_scale import ReturnScale, on_task_scales, task_scales

EVALUATION_EPISODES = 512  # of each task; R2 of Q needs the rows of hundreds
FRAME_BYTES = spec.DEPTH_ROWS * spec.DEPTH_COLS * 2 + 4 * (spec.STATE_DIM + 2 * spec.ACTION_DIM + 8)

type Built = tuple[PrefetchIterator, EpisodeStore, Mapping[str, ReturnScale]]


@dataclass(frozen=True)
class TrainingData:
    """The episodes of a run."""

    readers: tuple[DatasetReader, ...]
    """The datasets."""
    config: TrainConfig
    """The options, ``loading.mode`` no longer auto."""
    stream: PrefetchIterator
    """Batches of their windows."""
    heldout: EpisodeStore
    """Episodes to evaluate on."""
    return_scales: Mapping[str, ReturnScale]
    """Task -> the scale that its returns are on, under `returns.scale=per_task`; else empty."""


def prepare(config: TrainConfig, model: WorldModel, ranks: Ranks = ALONE) -> TrainingData:
    """Open the datasets and fix the model's statistics.

    What is on disk is read and checked as a whole; of a dataset that is streamed from the Hub a
    sample of its files.

    The first process goes ahead: it alone downloads, refuses what is wrong, and decides.

    Raises:
        UsageError: the options make no sense.
        DataError: a dataset is missing, damaged, not a number, or of another specification.
        EnvironmentFailure: the Hub cannot be reached.
    """
    if ranks.is_first:
        material = _prepare(config, model, ranks)
        ranks.decided(material.config.loading)
        return material
    loading = ranks.decided(config.loading)
    return _prepare(dataclasses.replace(config, loading=loading), model, ranks)


def _prepare(config: TrainConfig, model: WorldModel, ranks: Ranks) -> TrainingData:
    mix, sampling = mix_of(config), stream_config(config)
    sampling.check()
    config.loading.shuffle.check()
    config.returns.check()
    readers = open_readers(config)
    config = pinned(_decided(config, readers, ranks), readers)
    if config.loading.mode == "ram" and any(reader.is_remote for reader in readers):
        readers = open_readers(config)
    build = _in_memory if config.loading.mode == "ram" else _on_disk
    return TrainingData(readers, config, *build(readers, config, sampling, mix, model, ranks))


def open_readers(config: TrainConfig) -> tuple[DatasetReader, ...]:
    """The datasets, in the order given.

    Raises:
        UsageError: none is named, or --dataset and --datasets both are.
        DataError: one is missing, damaged, or of another specification.
        EnvironmentFailure: the Hub cannot be reached.
    """
    if not config.datasets:
        return (_open(config.dataset, config),)
    if config.dataset != SelectedDatasetConfig():
        raise UsageError("--dataset and --datasets both name data; give one of them")
    return tuple(_open(dataset, config) for dataset in config.datasets)


def _open(dataset: DatasetConfig, config: TrainConfig) -> DatasetReader:
    if config.loading.mode == "ram":
        return DatasetReader.open(dataset)
    return DatasetReader.on_demand(dataset, config.loading.network)


def pinned(config: TrainConfig, readers: Sequence[DatasetReader]) -> TrainConfig:
    """The options with the absolute path of each folder, and the commit of each dataset of the
    Hub, so that a resumed run finds the same data from any working directory, whatever is pushed
    meanwhile."""
    if not config.datasets:
        return dataclasses.replace(config, dataset=_pinned(config.dataset, readers[0]))
    both = zip(config.datasets, readers, strict=True)
    return dataclasses.replace(config, datasets=tuple(_pinned(d, r) for d, r in both))


def _pinned[D: DatasetConfig](config: D, reader: DatasetReader) -> D:
    if config.root:
        return dataclasses.replace(config, root=str(local_root(config)))
    if is_local(config):
        return config
    return dataclasses.replace(config, revision=reader.source.commit)


def require_datasets(config: TrainConfig, saved: Mapping[str, Any]) -> None:
    """See that the dataset folders of a resumed run are there.

    Args:
        config: the options.
        saved: those that the run has kept.

    Raises:
        DataError: one is not; the message says where the run had it and which flag says where it
            is now.
    """
    folders = [d for d in config.datasets or (config.dataset,) if d.root]
    missing = [local_root(d) for d in folders if not (local_root(d) / INFO_PATH).is_file()]
    if not missing:
        return
    before = saved.get("datasets") or [saved.get("dataset", {})]
    stored = [str(entry["root"]) for entry in before if entry.get("root")]
    if not stored:
        raise DataError(f"no dataset at {missing[0]}")
    flag = "--dataset.root=FOLDER"
    if config.datasets:
        entries = [{k: v for k, v in entry.items() if v not in (None, "")} for entry in before]
        flag = f"--datasets='{json.dumps(entries)}' with the new folders"
    raise DataError(
        f"no dataset at {missing[0]}; {config.output_dir}/{CONFIG_FILE} has {', '.join(stored)}: "
        f"if the data was moved, resume with {flag}"
    )


def require_same_content(readers: Sequence[DatasetReader], digests: Sequence[str]) -> None:
    """See that a resumed run goes on with its own data, wherever that lies now.

    Args:
        readers: the datasets.
        digests: `DatasetReader.content_digest` of those that the run was started with.

    Raises:
        DataError: a dataset is another one.
    """
    found = [reader.content_digest for reader in readers]
    if len(found) != len(digests):
        raise DataError(
            f"cannot resume with {len(found)} datasets: the run was started with {len(digests)}"
        )
    for reader, digest, before in zip(readers, found, digests, strict=True):
        if digest != before:
            raise DataError(
                f"cannot resume with {reader.root}: its episodes are not those that the run was "
                "started with; give the same data (an unchanged copy will do), or start a new run"
            )


def mix_of(config: TrainConfig) -> Mix:
    """The weights of datasets and tasks.

    Raises:
        UsageError: some datasets have a weight and others none, or a weight makes no sense.
    """
    weights = [d.weight for d in config.datasets if d.weight is not None]
    if len(weights) not in (0, len(config.datasets)):
        raise UsageError("--datasets: give every dataset a weight, or none")
    mix = Mix(tuple(weights), config.sampling.tasks)
    mix.check()
    return mix


def stream_config(config: TrainConfig) -> SamplerConfig:
    """How windows are drawn."""
    sampling = config.sampling
    return SamplerConfig(
        batch_size=config.batch_size,
        length=sampling.length,
        burn_in=sampling.burn_in,
        mirror=sampling.mirror,
        seed=config.seed,
    )


def _decided(config: TrainConfig, readers: Sequence[DatasetReader], ranks: Ranks) -> TrainConfig:
    """The options with the mode that auto stands for here, so that a resumed run keeps it."""
    if config.loading.mode != "auto":
        return config
    needed = EpisodeIndex.of(readers).num_frames * FRAME_BYTES * ranks.local
    mode: Literal["ram", "stream"] = "ram" if 2 * needed <= available_bytes() else "stream"
    return dataclasses.replace(config, loading=dataclasses.replace(config.loading, mode=mode))


def _in_memory(
    readers: Sequence[DatasetReader],
    config: TrainConfig,
    sampling: SamplerConfig,
    mix: Mix,
    model: WorldModel,
    ranks: Ranks,
) -> Built:
    learning, heldout = (
        EpisodeStore.load(readers, split, config.returns) for split in ("train", "heldout")
    )
    scales: dict[str, ReturnScale] = {}
    if config.returns.scale == "per_task":
        scales = task_scales(learning)
        learning, heldout = (on_task_scales(store, scales) for store in (learning, heldout))
    complete = np.bincount(np.repeat(learning.dataset, learning.length), weights=learning.mc_valid)
    _require_returns(readers, learning.dataset, complete)
    set_normalisation(model, learning, config.returns)
    rows = ranks.rows(sampling.batch_size)
    sampling = dataclasses.replace(sampling, batch_size=ranks.count * sampling.batch_size)
    stream = PrefetchIterator(InMemorySampler(learning, sampling, mix, rows))
    return stream, heldout, scales


def _on_disk(
    readers: Sequence[DatasetReader],
    config: TrainConfig,
    sampling: SamplerConfig,
    mix: Mix,
    model: WorldModel,
    ranks: Ranks,
) -> Built:
    if config.returns.scale == "per_task":
        raise UsageError(
            "--returns.scale=per_task needs all episodes in memory, and these are read from the "
            "disk; give --loading.mode=ram, or --returns.scale=dataset"
        )
    learning, unseen = (EpisodeIndex.of(readers, split) for split in ("train", "heldout"))
    sample = learning
    if learning.is_remote:
        sample, unseen = sample_files(learning, unseen, config.loading.sample_files)
        for part in (sample, unseen):
            part.download()
    heldout = EpisodeStore.read(unseen.subsample(EVALUATION_EPISODES), config.returns)
    if learning.is_remote:
        facts = estimate_training_stats(learning, sample, config.returns)
    else:
        facts = compute_training_stats(learning, config.returns)
    _require_returns(readers, sample.dataset, facts.complete)
    longest = int(learning.length.max())
    state = facts.state_mean, facts.state_std
    fix_normalisation(model, *state, facts.returns, longest, config.returns)
    stream = StreamingSampler(
        learning,
        sampling,
        mix,
        config.loading.shuffle,
        returns=config.returns,
        checked=not learning.is_remote,
        rank=ranks.rank,
        ranks=ranks.count,
    )
    return PrefetchIterator(stream), heldout, {}


def _require_returns(
    readers: Sequence[DatasetReader], dataset: NDArray[np.int64], complete: NDArray[Any]
) -> None:
    """Raise `DataError` for one of several datasets that would teach Q nothing.

    Args:
        readers: the datasets.
        dataset: (E,) which of them each episode is of.
        complete: (D,) rows of each that have a complete return.
    """
    without = [number for number in np.unique(dataset).tolist() if not complete[number]]
    if without and complete.any():
        raise DataError(
            f"{readers[without[0]].root}: no row has a complete Monte Carlo return, though rows of "
            "other datasets have: its episodes are not longer than --returns.steps; lower it, "
            "or leave the dataset out"
        )
