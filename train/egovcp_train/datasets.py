"""What a run trains on: one dataset or several, and how often each of them is drawn."""

from __future__ import annotations

from egovcp.cli import DatasetConfig
from egovcp.data import DatasetReader, Mix
from egovcp.errors import UsageError
from egovcp_train.config import TrainConfig


def open_readers(config: TrainConfig) -> tuple[DatasetReader, ...]:
    """The datasets, in the order given.

    Raises:
        UsageError: none is named, or --dataset and --datasets both are.
        DataError: one is missing, damaged, or of another specification.
        EnvironmentFailure: the Hub cannot be reached.
    """
    if not config.datasets:
        return (DatasetReader.open(config.dataset),)
    if config.dataset != DatasetConfig():
        raise UsageError("--dataset and --datasets both name data; give one of them")
    return tuple(DatasetReader.open(dataset) for dataset in config.datasets)


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
