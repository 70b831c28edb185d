"""`egovcp-mcap from-dataset`: convert an episode of a dataset to a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from egovcp.cli import DatasetConfig
from egovcp.errors import UsageError
from egovcp.log.mcap import McapSink
from egovcp.outputs import output_file
from egovcp.packages import DATA_MODULES, require_packages
from egovcp.terminal import echo


@dataclass(frozen=True)
class FromDatasetConfig:
    """Convert an episode of a dataset to a recording (MCAP); `to-dataset` restores the rows."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id on the Hub."""
    episode: int = 0
    """Index of the episode, from 0."""
    output: str = output_file()
    """The new recording."""


def run(config: FromDatasetConfig) -> None:
    """Write the recording. Raises `UsageError` for a missing episode or output, `DataError` for a
    damaged dataset, `EnvironmentFailure` if the output exists or a package is missing."""
    if not config.output:
        raise UsageError(
            "no output given; usage: egovcp-mcap from-dataset ROOT OUT.mcap --episode=N"
        )
    require_packages("egovcp-deploy", "reading a dataset", *DATA_MODULES)
    from egovcp.data import DatasetReader
    from egovcp.rollouts import run_info, ticks_of

    reader = DatasetReader.open(config.dataset)
    if not 0 <= config.episode < len(reader):
        raise UsageError(
            f"--episode={config.episode}: {reader.root} has episodes 0 to {len(reader) - 1}"
        )
    episode = reader.read(config.episode)
    sink = McapSink(Path(config.output))
    sink.open(run_info(reader, config.episode, episode))
    try:
        for tick in ticks_of(episode):
            sink.write(tick)
        sink.close()
    except BaseException:
        sink.discard()
        raise
    echo(f"{config.output}: {len(episode)} ticks of {episode.task}")
