"""`egovcp-dataset viz`: an episode of a dataset as a recording."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

from egovcp.data import DatasetConfig, DatasetReader
from egovcp.data.lerobot import LeRobotReader, is_own
from egovcp.data.source import locate, locate_on_demand
from egovcp.errors import UsageError
from egovcp.files import removed_on_error, user_path
from egovcp.log.tick import Sink
from egovcp.outputs import output_file, require_writable
from egovcp.packages import require_packages
from egovcp.rollouts import POSE, recording_info, ticks_of
from egovcp.terminal import echo


@dataclass(frozen=True)
class VizConfig:
    """Write an episode as a Rerun or MCAP recording.

    It shows depth, actions, rewards and state. Of the G1 it also shows the robot's pose and the
    hand targets; the pelvis pose is not part of a dataset, so the robot is drawn at the origin, at
    its commanded height, tilted as its IMU measured. Of a LeRobot v3 dataset that egovcp did not
    collect, it shows the images and a curve of every number.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub, of which only the file of the episode is
    downloaded, but the whole dataset if egovcp did not collect it."""
    episode: int = 0
    """Index of the episode, counted from 0."""
    output: str = output_file()
    """Recording to create; empty: NAME-episode-N.rrd in the current folder. A name that ends in
    .mcap: MCAP, as egovcp-deploy writes and replays it, of datasets that egovcp collected."""
    spawn: bool = False
    """Open the recording in the Rerun viewer."""


def run_viz(config: VizConfig) -> None:
    """Write the recording.

    Raises:
        UsageError: there is no such episode, or MCAP is asked for a dataset of another origin.
        DataError: the dataset or the episode is damaged.
        EnvironmentFailure: a package is missing, the Hub cannot be reached, or the recording
            exists or cannot be written.
    """
    require_packages("egovcp-collect", "the recording", "mcap", "rerun")
    source, cache = locate_on_demand(config.dataset)
    reader: DatasetReader | LeRobotReader
    if is_own(source.root):
        reader = DatasetReader.open_source(source, cache)
        count = len(reader)
    elif Path(config.output).suffix == ".mcap":
        raise UsageError(
            f"--output={config.output}: MCAP needs a dataset that egovcp collected; name a .rrd"
        )
    else:
        if cache is not None:
            source = locate(replace(config.dataset, revision=source.commit))
        reader = LeRobotReader.open(source.root)
        count = len(reader.rows)
    if not 0 <= config.episode < count:
        raise UsageError(f"--episode={config.episode}: {source.root} has episodes 0 to {count - 1}")
    name = source.root.name
    if source.commit:  # the folder of a downloaded dataset is named after its commit
        name = source.repo_id.partition("/")[2]
    output = user_path(config.output or f"{name}-episode-{config.episode}.rrd")
    require_writable(output.parent)
    if isinstance(reader, DatasetReader):
        write_recording(reader, config.episode, output)
        echo(f"wrote {output}; {POSE}" if reader.robot.is_g1 else f"wrote {output}")
    else:
        from egovcp_collect.dataset.feature_recording import record_features

        shown = record_features(reader, reader.rows[config.episode], output)
        echo(f"wrote {output}: {', '.join(shown)}; not shown: the robot, whose model is not known")
    if config.spawn:  # the viewer outlives this command; it accepts local connections only
        command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(output)]
        subprocess.Popen(command, start_new_session=True)
    else:
        echo(f"open it with: rerun {output}")


def write_recording(reader: DatasetReader, index: int, output: Path, meshes: bool = True) -> None:
    """Write episode ``index`` as the new recording ``output``: MCAP by its name, else Rerun.

    Raises:
        DataError: the episode is damaged.
        EnvironmentFailure: ``output`` exists.
    """
    from egovcp.log.mcap import McapSink
    from egovcp.log.rerun import RerunSink

    episode = reader.read(index)
    output.parent.mkdir(parents=True, exist_ok=True)
    if output.suffix == ".mcap":
        sink: Sink = McapSink(output)
    else:
        sink = RerunSink(output, meshes=meshes, signals=True)
    sink.open(recording_info(reader, index, episode))
    with removed_on_error(output):
        for tick in ticks_of(episode):
            sink.write(tick)
        sink.close()
