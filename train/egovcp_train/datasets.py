"""Training data of a run: datasets and their weights, batches, normalisation, held-out episodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import (
    DatasetReader,
    EpisodeIndex,
    EpisodeStore,
    InMemorySampler,
    Mix,
    ReturnConfig,
    SamplerConfig,
    StreamingSampler,
    sample_files,
)
from egovcp.data.convert import convert_dataset
from egovcp.data.episode import frame_bytes
from egovcp.data.lerobot import is_own
from egovcp.data.samplers import PrefetchIterator
from egovcp.data.schema import INFO_PATH
from egovcp.data.source import is_local, local_root, locate
from egovcp.dataset_options import DatasetConfig, SelectedDatasetConfig
from egovcp.errors import DataError, UsageError
from egovcp.files import user_path
from egovcp.hardware import available_bytes, require_memory
from egovcp.model import Batch, WorldModel
from egovcp.robot_spec import RobotSpec
from egovcp_train.checkpoint import CONFIG_FILE
from egovcp_train.config import TrainConfig

EVALUATION_EPISODES: Final = 512
"""At most this many held-out episodes of each task; with fewer, R2 of Q depends on which ones they
are."""
_BATCH_COPIES: Final = 4  # of a batch on a CPU: float32, and intermediate results of gradients
_RETURNS: Final = ReturnConfig()

type Loaded = tuple[PrefetchIterator, EpisodeStore, Callable[[], EpisodeStore]]


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
    training_episodes: Callable[[], EpisodeStore]
    """Returns the training episodes: those in memory, or in mode stream without images (of a
    dataset on the Hub, those of some files)."""


def check_options(config: TrainConfig) -> None:
    """Raise `UsageError` for options of the data that contradict each other; no data is read."""
    if config.features and (config.datasets or config.resume):
        raise UsageError(
            "--features is for the --dataset of a new run; leave it out with --datasets, which "
            "takes converted ones, and with --resume"
        )
    if config.features and config.returns.weights:
        raise UsageError(
            "--returns.weights: a dataset with --features has one reward, without named terms; "
            "leave the weights out"
        )
    mix_of(config)
    sampler_config(config).check()
    config.loading.shuffle.check()
    config.returns.check()


def require_batch_memory(config: TrainConfig, device: torch.device, robot: RobotSpec) -> None:
    """Raise `UsageError` for a batch of ``robot``'s data that is too large for this machine."""
    size, length = config.batch_size, config.sampling.length
    option = f"--batch_size={size} with --sampling.length={length}"
    copies = _BATCH_COPIES if device.type == "cpu" else 1
    require_memory(option, size * length * copies * frame_bytes(robot))


def prepare(
    config: TrainConfig, readers: tuple[DatasetReader, ...], model: WorldModel
) -> TrainingData:
    """Read the datasets and fix the model's statistics.

    Local datasets are read and checked completely, of datasets that are streamed from the Hub a
    sample of the files.

    Raises:
        UsageError: the options contradict each other.
        DataError: a dataset is damaged, or not finite.
        EnvironmentFailure: the Hub cannot be reached.
    """
    for reader in readers:
        if config.returns.weights and spec.REWARD_TERMS_KEY not in reader.features:
            raise UsageError(
                f"--returns.weights: {reader.root} was written by an earlier version and does not "
                "have the reward terms; leave the weights out, or collect again"
            )
    config = pinned(_resolved(config, readers), readers)
    if config.loading.mode == "ram" and any(reader.is_remote for reader in readers):
        readers = open_readers(config)
    build = _in_memory if config.loading.mode == "ram" else _on_disk
    return TrainingData(readers, config, *build(readers, config, model))


def convert_if_needed(config: TrainConfig) -> TrainConfig:
    """Convert --dataset to OUTPUT_DIR/dataset if --features is given; return options that name the
    result.

    Raises:
        UsageError: the dataset has no such features.
        DataError: it is missing or damaged.
        EnvironmentFailure: the Hub cannot be reached.
    """
    if not config.features:
        return config
    root = user_path(config.output_dir).absolute() / "dataset"
    source = locate(config.dataset, config.loading.network)
    convert_dataset(source, config.features, root, config.dataset.episodes)
    dataset = SelectedDatasetConfig(repo_id=config.dataset.repo_id, root=str(root))
    return dataclasses.replace(config, dataset=dataset, features={})


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
    try:
        if config.loading.mode == "ram":
            return DatasetReader.open(dataset)
        return DatasetReader.on_demand(dataset, config.loading.network)
    except DataError as error:
        info = Path(error.file)
        if info.name != Path(INFO_PATH).name or is_own(info.parents[1]):
            raise
        raise DataError(
            f"{info.parents[1]} does not have egovcp's features ({error.problem}); name the right "
            "ones with --features='{image: NAME}', see --help"
        ) from error


def pinned(config: TrainConfig, readers: Sequence[DatasetReader]) -> TrainConfig:
    """The options with absolute paths of folders and commits of datasets on the Hub, so that a
    resumed run finds the same data."""
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


def require_datasets(config: TrainConfig) -> None:
    """Raise `DataError`, with a remedy, if a dataset folder of a resumed run is missing."""
    flag = "--datasets=[{root: FOLDER, ...}, ...]" if config.datasets else "--dataset.root=FOLDER"
    for dataset in config.datasets or (config.dataset,):
        if dataset.root and not (local_root(dataset) / INFO_PATH).is_file():
            raise DataError(
                f"no dataset at {local_root(dataset)}; {config.output_dir}/{CONFIG_FILE} has the "
                f"datasets of the run: if the data was moved, resume with {flag}"
            )


def require_same_content(readers: Sequence[DatasetReader], digests: Sequence[str]) -> None:
    """Raise `DataError` unless a resumed run continues with the same data, in any location.

    Args:
        digests: `DatasetReader.content_digest` of those that the run was started with.
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
        UsageError: some datasets have a weight and others none, or a weight is invalid.
    """
    weights = [d.weight for d in config.datasets if d.weight is not None]
    if len(weights) not in (0, len(config.datasets)):
        raise UsageError("--datasets: give every dataset a weight, or none")
    mix = Mix(tuple(weights), config.sampling.tasks)
    mix.check()
    return mix


def sampler_config(config: TrainConfig) -> SamplerConfig:
    """How windows are drawn."""
    own = config.sampling
    return SamplerConfig(config.batch_size, own.length, own.burn_in, own.mirror, seed=config.seed)


def _resolved(config: TrainConfig, readers: Sequence[DatasetReader]) -> TrainConfig:
    """The options with the mode that auto selects here, so that a resumed run keeps it."""
    if config.loading.mode != "auto":
        return config
    index = EpisodeIndex.of(readers)
    needed = index.num_frames * frame_bytes(index.robot)
    mode: Literal["ram", "stream"] = "ram" if 2 * needed <= available_bytes() else "stream"
    return dataclasses.replace(config, loading=dataclasses.replace(config.loading, mode=mode))


def _in_memory(readers: Sequence[DatasetReader], config: TrainConfig, model: WorldModel) -> Loaded:
    training, heldout = (
        EpisodeStore.load(readers, split, config.returns) for split in ("train", "heldout")
    )
    _require_returns(readers, training)
    set_normalisation(model, training, config.returns)
    sampler = InMemorySampler(training, sampler_config(config), mix_of(config))
    return PrefetchIterator(sampler), heldout, lambda: training


def _on_disk(readers: Sequence[DatasetReader], config: TrainConfig, model: WorldModel) -> Loaded:
    training, unseen = (EpisodeIndex.of(readers, split) for split in ("train", "heldout"))
    sample = training
    if training.is_remote:
        sample, unseen = sample_files(training, unseen, config.loading.sample_files)
        for part in (sample, unseen):
            part.download()
    heldout = EpisodeStore.read(unseen.subsample(EVALUATION_EPISODES), config.returns)
    without_images = partial(EpisodeStore.read, sample, config.returns, images=False)
    store = without_images()
    _require_returns(readers, store)
    state = training.state_statistics() if training.is_remote else None
    set_normalisation(model, store, config.returns, state)
    stream = StreamingSampler(
        training,
        sampler_config(config),
        mix_of(config),
        config.loading.shuffle,
        config.returns,
        checked=not training.is_remote,
    )
    return PrefetchIterator(stream), heldout, without_images


def _require_returns(readers: Sequence[DatasetReader], store: EpisodeStore) -> None:
    """Raise `DataError` for one of several datasets without a return that Q can learn."""
    complete = np.bincount(np.repeat(store.dataset, store.length), weights=store.mc_valid)
    without = [number for number in np.unique(store.dataset).tolist() if not complete[number]]
    if without and complete.any():
        raise DataError(
            f"{readers[without[0]].root}: no row has a complete Monte Carlo return, though rows of "
            "other datasets have: its episodes are not longer than --returns.steps; lower it, "
            "or leave the dataset out"
        )


# --- batches and normalisation -------------------------------------------------------
def to_tensors(arrays: Mapping[str, NDArray[Any]], device: torch.device) -> Batch:
    """A batch of `InMemorySampler` as the tensors that the losses read."""
    depth = torch.from_numpy(arrays["depth"].astype(np.int32))
    rest = {k: torch.from_numpy(arrays[k]) for k in Batch._fields if k != "depth"}
    tensors = {"depth": depth, **rest}
    return Batch(**{k: v.to(device, non_blocking=True) for k, v in tensors.items()})


def set_normalisation(
    model: WorldModel,
    store: EpisodeStore,
    config: ReturnConfig = _RETURNS,
    state: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> None:
    """Set the model's statistics from the training episodes.

    Args:
        store: the episodes, or a sample of them.
        config: definition of their returns.
        state: mean and standard deviation (S,) of the state; None: those of ``store``.

    Raises:
        DataError: no return is complete, because the episodes are too short.
    """
    if not store.mc_valid.any():
        raise DataError(
            f"no row has a complete Monte Carlo return: the episodes (at most {store.length.max()} "
            "ticks) are not longer than --returns.steps; lower it, or collect longer episodes"
        )
    values = store.state.astype(np.float64)
    mean, std = state or (values.mean(0), values.std(0))
    returns = store.mc_return[store.mc_valid]
    model.set_statistics(mean, std, returns, config.scale != "none", config.gamma)
