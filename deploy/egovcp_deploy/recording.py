"""What a run leaves behind: its log, and what describes it at the beginning of each log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egovcp.artifact import Artifact
from egovcp.log.async_sink import AsyncFanout, AsyncSink
from egovcp.log.mcap import McapSink
from egovcp.log.rerun import RerunSink
from egovcp.log.sink import Fanout, Sink
from egovcp.log.tick import CameraView, RunInfo
from egovcp.log.viewer import LiveRerun
from egovcp.packages import is_installed
from egovcp.terminal import echo
from egovcp_deploy.options import versions


@dataclass(frozen=True)
class LogOptions:
    """What is recorded beside the MCAP, and who is looking."""

    live: str = ""
    """Also show the run as it happens: spawn (the Rerun viewer), web (a page for browsers, on the
    loopback), or the address of a viewer that runs, rerun+http://127.0.0.1:9876/proxy."""
    rrd: bool = True
    """Write a Rerun file too; egovcp-deploy's MCAP alone can be opened in Rerun as well."""


@contextmanager
def recording(
    folder: Path, episode: int, info: RunInfo, options: LogOptions, waits: bool
) -> Iterator[Sink]:
    """Sinks of one rollout; the first rollout leaves a picture too.

    Args:
        folder: where the files go.
        episode: number of the rollout.
        info: the first record.
        options: which logs.
        waits: whether the loop may wait for the disk, as simulated time may. On the wall clock
            each sink has a process of its own. A viewer always has: it may die or hang.
    """
    with ExitStack() as stack:
        files = _files(folder / f"rollout-{episode}", episode, options)
        viewers = list(_viewers(options, stack))
        sink: Sink
        if waits:
            sink = Fanout([*files.values(), *viewers])
        else:
            writers = [AsyncSink(file, name) for name, file in files.items()]
            sink = AsyncFanout([*writers, *viewers])
        stack.callback(sink.close)
        sink.open(info)
        yield sink


def missing_ticks(sink: Sink) -> dict[str, int]:
    """Log -> ticks that are not in it, or may not be, once it is closed; only of `recording` on
    the wall clock, which drops rather than waits."""
    sinks = sink.sinks if isinstance(sink, AsyncFanout) else ()
    return {each.name: each.dropped + each.lost for each in sinks}


def _files(stem: Path, episode: int, options: LogOptions) -> dict[str, Sink]:
    """File name -> what writes it."""
    mcap, rrd, png = (stem.with_suffix(suffix) for suffix in (".mcap", ".rrd", ".png"))
    sinks: dict[str, Sink] = {mcap.name: McapSink(mcap)}
    if options.rrd:
        sinks[rrd.name] = RerunSink(rrd)
    if episode == 0 and is_installed("matplotlib"):
        from egovcp.log.picture import PictureSink

        sinks[png.name] = PictureSink(png)
    return sinks


def _viewers(options: LogOptions, stack: ExitStack) -> Iterator[AsyncSink]:
    if options.live:
        live = stack.enter_context(LiveRerun.of(options.live))
        if live.page:
            echo(f"look at it: {live.page}")
        yield AsyncSink(RerunSink(live.viewer), "Rerun")


def run_info(
    task: str,
    seed: int,
    episode: int,
    camera: CameraView,
    config: Mapping[str, Any],
    controller_id: str,
    artifact: Artifact | None,
    backend: str,
) -> RunInfo:
    """The first record of a log. ``config`` holds JSON values, ``backend`` see `backend_of`."""
    files = artifact.manifest["files"] if artifact else {}
    return RunInfo(
        task=task,
        seed=seed,
        episode=episode,
        camera=camera,
        config=config,
        hashes={"low_level_controller": controller_id, **files},
        versions=versions(),
        backend=backend,
    )
