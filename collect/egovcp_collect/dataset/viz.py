"""`egovcp-dataset viz`: an episode of a dataset in Rerun.

The pelvis pose is not recorded, as no real robot measures it: the robot stands at the origin, at
its commanded height, tilted as its IMU says. It therefore does not walk about, and depth is
placed relative to it.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from egovcp.data import DatasetConfig, DatasetReader, Episode
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.log.info import CameraView, RunInfo
from egovcp.log.tick import Tick
from egovcp.spec import PLANNER_HZ

_TICK_NS: Final = 1_000_000_000 // PLANNER_HZ
_EVENT: Final = {"ball": "the ball is thrown", "wall": "the push", "arch": "the way to the arch"}
_POSE: Final = (
    "The pelvis pose is not recorded: the robot is drawn at the origin, at its commanded height, "
    "tilted as its IMU says."
)


@dataclass(frozen=True)
class VizConfig:
    """Show an episode in Rerun: depth, the robot's pose, hand targets, actions, rewards, state.

    The pelvis pose is not part of a dataset: the robot is drawn at the origin, at its commanded
    height, tilted as its IMU says.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    episode: int = 0
    """Which episode, counted from 0."""
    output: str = ""
    """Recording to create; empty: NAME-episode-N.rrd in the present folder."""
    spawn: bool = False
    """Open the recording in the Rerun viewer at once."""


CONFIG = VizConfig


def run(config: VizConfig) -> None:
    """Write the recording, and open it if asked to.

    Raises:
        UsageError: there is no such episode.
        DataError: the dataset is damaged.
        EnvironmentFailure: Rerun is not installed, or the recording exists already.
    """
    if find_spec("rerun") is None:
        raise EnvironmentFailure(
            "the recording needs rerun-sdk, which is not installed: pip install "
            "'egovcp-collect[viz]'"
        )
    reader = DatasetReader.open(config.dataset)
    if not 0 <= config.episode < len(reader):
        raise UsageError(
            f"--episode={config.episode}: {reader.root} has episodes 0 to {len(reader) - 1}"
        )
    name = f"{reader.root.name}-episode-{config.episode}.rrd"
    if reader.source.commit:  # the folder of a downloaded dataset is named after its commit
        name = f"{reader.source.repo_id.partition('/')[2]}-episode-{config.episode}.rrd"
    output = Path(config.output or name)
    write_recording(reader, config.episode, output)
    print(f"wrote {output}; {_POSE}")
    if config.spawn:
        open_viewer(output)
    else:
        print(f"open it with: rerun {output}")


def write_recording(reader: DatasetReader, index: int, output: Path, meshes: bool = True) -> None:
    """Write episode ``index`` as the Rerun recording ``output``.

    Raises:
        EnvironmentFailure: ``output`` exists.
    """
    from egovcp.log.rerun import RerunSink

    episode = reader.read(index)
    output.parent.mkdir(parents=True, exist_ok=True)
    sink = RerunSink(output, imagined=(), meshes=meshes, signals=True)
    sink.open(run_info(reader, index, episode))
    for tick in ticks_of(episode):
        sink.write(tick)
    sink.close()


def run_info(reader: DatasetReader, index: int, episode: Episode) -> RunInfo:
    """What the recording says of the episode before its first tick."""
    facts, known = episode.metadata, reader.provenance
    return RunInfo(
        task=episode.task,
        seed=int(facts.get("seed") or 0),
        episode=int(facts.get("episode", index)),
        camera=camera_view(known.get("config", {}), facts),
        config={
            "pose": _POSE,
            "dataset": str(reader.root),
            "index in the dataset": index,
            "scenario": dict(facts),
            "command": known.get("command", ""),
        },
        hashes={"controller": reader.controller_id, "dataset commit": reader.source.commit},
        versions=dict(known.get("versions", {})),
    )


def camera_view(config: Mapping[str, Any], facts: Mapping[str, Any]) -> CameraView:
    """The camera as it was mounted in an episode; the default where that is not recorded."""
    camera, usual = config.get("env", {}).get("camera", {}), CameraView()
    x, y, z = camera.get("position", usual.position)
    return CameraView(
        position=(x, y, z),
        pitch=facts.get("camera_pitch", usual.pitch),
        vertical_fov=camera.get("vertical_fov", usual.vertical_fov),
    )


def ticks_of(episode: Episode) -> Iterator[Tick]:
    """The rows of an episode as the logs know them."""
    for t in range(len(episode)):
        ended = bool(episode.done[t])
        yield Tick(
            index=t,
            time_ns=t * _TICK_NS,
            depth=episode.depth[t],
            state=episode.state[t],
            action_planned=episode.action[t],
            action_sent=episode.action[t],
            reward=float(episode.reward[t]),
            terminated=ended and not episode.truncated[t],
            truncated=bool(episode.truncated[t]),
            success=bool(episode.success[t]),
            events=tuple(_events(episode, t)),
        )


def _events(episode: Episode, t: int) -> Iterator[str]:
    if t == episode.metadata.get("event_tick"):
        yield _EVENT[episode.task]
    if t > 0 and episode.success[t] != episode.success[t - 1]:
        yield "success" if episode.success[t] else "no success any more"
    if abs(episode.reward[t] - np.median(episode.reward)) > _STANDS_OUT:
        yield f"reward {episode.reward[t]:+.3f}"
    if episode.done[t]:
        yield "a fall ends the episode" if episode.terminated else "the time is up"


_STANDS_OUT: Final = 0.2  # a block, a hit, a passage or a fall; not a tick of bracing


def open_viewer(recording: Path) -> None:
    """Start the Rerun viewer on a file, as a process of its own that listens to nobody else."""
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(recording)]
    subprocess.Popen(command, start_new_session=True)
