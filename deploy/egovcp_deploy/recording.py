"""Logs of a rollout, and the records that describe it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egovcp.artifact import Artifact
from egovcp.bounds import bounded
from egovcp.log.async_sink import AsyncFanout, AsyncSink, warn_on_stderr
from egovcp.log.mcap import McapSink
from egovcp.log.tick import CONTROLLER, CameraView, Fanout, RunInfo, Sink
from egovcp.packages import is_installed
from egovcp.terminal import echo
from egovcp_deploy.options import evaluation_versions, video_paths

if TYPE_CHECKING:
    from egovcp.log.viewer import Viewer
    from egovcp_deploy.config import DeployConfig


@dataclass(frozen=True)
class LogOptions:
    """Logs besides the MCAP file."""

    live: str = ""
    """Also show the run as it happens: spawn (the Rerun viewer), web (a page for browsers, on the
    loopback), or the address of a running viewer, rerun+http://127.0.0.1:9876/proxy."""
    rrd: bool = True
    """Write a Rerun file too; Rerun also opens the MCAP file."""
    videos: int = bounded(1, least=0, most=1_000_000)
    """Render the first N rollouts as PNG and GIF, and as MP4 if PyAV is installed
    (egovcp[video]); needs matplotlib. A live run of a robot is not rendered: replay its MCAP file
    (--robot.type=replay)."""


@contextmanager
def open_viewer(options: LogOptions) -> Iterator[Viewer | None]:
    """The viewer of ``--log.live``, for all rollouts of a run; None without that option."""
    if not options.live:
        yield None
        return
    from egovcp.log.viewer import LiveRerun  # takes half a second

    with LiveRerun.of(options.live) as live:
        if live.page:
            echo(f"Rerun viewer: {live.page}")
        yield live.viewer


@contextmanager
def recording(
    folder: Path,
    info: RunInfo,
    options: LogOptions,
    viewer: Viewer | None,
    blocking: bool,
    number: int = 0,
    warn: Callable[[str], None] = warn_on_stderr,
) -> Iterator[Sink]:
    """Sinks of rollout ``number``. If ``blocking``, the loop may wait for the disk, as in simulated
    time; else nothing is rendered, each sink, like any viewer, runs in a separate process, and
    ``warn`` gets their messages."""
    stem = folder / f"rollout-{number}"
    mcap, rrd = stem.with_suffix(".mcap"), stem.with_suffix(".rrd")
    files: dict[str, Sink] = {mcap.name: McapSink(mcap)}
    if options.rrd:
        from egovcp.log.rerun import RerunSink

        files[rrd.name] = RerunSink(rrd)
    if blocking and number < options.videos and is_installed("matplotlib"):
        from egovcp.log.rollout_video import RolloutVideoSink

        files[f"{stem.name}.gif"] = RolloutVideoSink(stem.with_suffix(".png"), *video_paths(stem))
    viewers = list[AsyncSink]()
    if viewer is not None:
        from egovcp.log.rerun import RerunSink

        viewers.append(AsyncSink(RerunSink(viewer), "Rerun", warn=warn))
    sink: Sink
    if blocking:
        sink = Fanout([*files.values(), *viewers])
    else:
        sink = AsyncFanout(
            [*(AsyncSink(f, name, warn=warn) for name, f in files.items()), *viewers]
        )
    with closing(sink):
        sink.open(info)
        yield sink


def print_viewer_command(rrd: Path) -> None:
    """Print the command that opens a Rerun file; nothing if it is missing."""
    if rrd.is_file():
        echo(f"view it with: rerun {shlex.quote(str(rrd))}")


def missing_ticks(sink: Sink) -> dict[str, int]:
    """Log -> how many steps may be missing in it, of a closed `recording` that was not blocking."""
    sinks = sink.sinks if isinstance(sink, AsyncFanout) else ()
    return {each.name: each.dropped + each.lost for each in sinks}


def make_run_info(
    config: DeployConfig, controller_id: str, artifact: Artifact | None, backend: str
) -> RunInfo:
    """The first record of the log of a G1's rollout 0; ``backend`` see `backend_of`.

    Its camera is the configured one of a real robot, in the middle of the range of pitches.
    """
    files = artifact.manifest["files"] if artifact else {}
    mount, options = config.env.camera, config.robot.camera
    fov = (options.realsense if options.type == "realsense" else options.server).vertical_fov
    return RunInfo(
        task=config.task,
        seed=config.seed,
        camera=CameraView(
            position=mount.position, pitch=sum(mount.pitch_range) / 2, vertical_fov=fov
        ),
        config=config.encoded(),
        hashes={CONTROLLER: controller_id, **files},
        versions=evaluation_versions(),
        backend=backend,
    )


def percentiles(name: str, values: list[float]) -> dict[str, float]:
    """Median and 99th percentile, for ``deploy.json``."""
    p50, p99 = np.percentile(values or [0.0], [50, 99])
    return {f"{name}_p50": float(p50), f"{name}_p99": float(p99)}


def provenance_fields(info: RunInfo) -> dict[str, Any]:
    """The part of ``deploy.json`` that says what produced the results."""
    files = {name: value for name, value in info.hashes.items() if name != CONTROLLER}
    return {
        "config": info.config,
        "artifact": files or None,  # None: no artifact
        CONTROLLER: info.hashes[CONTROLLER],
        "backend": info.backend,
        "versions": info.versions,
    }
