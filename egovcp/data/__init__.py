"""Datasets: episodes as arrays, the LeRobot writer and reader, training batches.

In one line, all frames of a dataset as arrays::

    EpisodeStore.load([DatasetReader.open(DatasetConfig(root="..."))])
"""

from egovcp.cli import DatasetConfig
from egovcp.data.episode import Episode
from egovcp.data.provenance import Provenance
from egovcp.data.reader import DatasetReader
from egovcp.data.store import EpisodeStore, ReturnConfig
from egovcp.data.stream import Batch, SequenceStream, StreamConfig
from egovcp.data.targets import is_terminal, mc_return, mc_valid
from egovcp.data.writer import DatasetWriter

__all__ = [
    "Batch",
    "DatasetConfig",
    "DatasetReader",
    "DatasetWriter",
    "Episode",
    "EpisodeStore",
    "Provenance",
    "ReturnConfig",
    "SequenceStream",
    "StreamConfig",
    "is_terminal",
    "mc_return",
    "mc_valid",
]
