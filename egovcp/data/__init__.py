"""Datasets: episodes as arrays, the LeRobot writer and reader, training batches.

In one line, a dataset as padded arrays [Batch, Time, Data]::

    load_arrays("data/ball")["action"]  # (B, T, 7)
"""

from egovcp.data.episode import Episode
from egovcp.data.index import EpisodeIndex, describe_heldout, sample_files
from egovcp.data.order import Mix
from egovcp.data.provenance import Provenance
from egovcp.data.reader import DatasetReader, load_arrays, open_dataset
from egovcp.data.returns import ReturnConfig, is_terminal, mc_return, mc_valid
from egovcp.data.samplers import InMemorySampler, SamplerConfig, ShuffleConfig, StreamingSampler
from egovcp.data.store import Batch, EpisodeStore
from egovcp.data.writer import DatasetWriter
from egovcp.dataset_options import DatasetConfig

__all__ = [
    "Batch",
    "DatasetConfig",
    "DatasetReader",
    "DatasetWriter",
    "Episode",
    "EpisodeIndex",
    "EpisodeStore",
    "InMemorySampler",
    "Mix",
    "Provenance",
    "ReturnConfig",
    "SamplerConfig",
    "ShuffleConfig",
    "StreamingSampler",
    "describe_heldout",
    "is_terminal",
    "load_arrays",
    "mc_return",
    "mc_valid",
    "open_dataset",
    "sample_files",
]
