"""Datasets: episodes as arrays, the LeRobot writer and reader, training batches.

In one line, a dataset as padded arrays [Batch, Time, Data]::

    load_arrays("data/ball")["action"]  # (B, T, 7)
"""

from egovcp.cli import DatasetConfig
from egovcp.data.arrays import load_arrays, open_dataset
from egovcp.data.bounded import BoundedStream, ShuffleConfig
from egovcp.data.episode import Episode
from egovcp.data.heldout import describe_heldout
from egovcp.data.index import EpisodeIndex
from egovcp.data.mix import Mix
from egovcp.data.order import Shard
from egovcp.data.provenance import Provenance
from egovcp.data.reader import DatasetReader
from egovcp.data.returns import ReturnConfig
from egovcp.data.sample import sample_files
from egovcp.data.store import EpisodeStore
from egovcp.data.stream import SequenceStream, StreamConfig
from egovcp.data.survey import Survey, survey, survey_sample
from egovcp.data.targets import is_terminal, mc_return, mc_valid
from egovcp.data.windows import Batch
from egovcp.data.writer import DatasetWriter

__all__ = [
    "Batch",
    "BoundedStream",
    "DatasetConfig",
    "DatasetReader",
    "DatasetWriter",
    "Episode",
    "EpisodeIndex",
    "EpisodeStore",
    "Mix",
    "Provenance",
    "ReturnConfig",
    "SequenceStream",
    "Shard",
    "ShuffleConfig",
    "StreamConfig",
    "Survey",
    "describe_heldout",
    "is_terminal",
    "load_arrays",
    "mc_return",
    "mc_valid",
    "open_dataset",
    "sample_files",
    "survey",
    "survey_sample",
]
