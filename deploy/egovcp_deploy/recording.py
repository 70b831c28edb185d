"""What a run leaves behind: its log, and what describes it at the beginning of each log."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egovcp.artefact import Artefact
from egovcp.log.background import BackgroundSink
from egovcp.log.info import CameraView, RunInfo
from egovcp.log.live import LiveRerun
from egovcp.log.mcap import McapSink
from egovcp.log.rerun import RerunSink
from egovcp.log.sink import Fanout, Sink
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
    folder: Path, episode: int, info: RunInfo, options: LogOptions, lossless: bool
) -> Iterator[Sink]:
    """Sinks of one rollout, each in a process of its own; the first rollout leaves a picture too.

    Args:
        folder: where the files go.
        episode: number of the rollout.
        info: the first record.
        options: which logs.
        lossless: rather wait than drop ticks, as simulated time may.
    """
    with ExitStack() as stack:
        sinks = [
            BackgroundSink(sink, name, lossless=lossless)
            for name, sink in _sinks(folder / f"rollout-{episode}", episode, options, stack)
        ]
        for background in sinks:
            background.start()
        sink = stack.enter_context(Fanout(sinks))
        sink.open(info)
        yield sink


def _sinks(
    stem: Path, episode: int, options: LogOptions, stack: ExitStack
) -> Iterator[tuple[str, Sink]]:
    """Name and sink."""
    mcap, rrd, png = (stem.with_suffix(suffix) for suffix in (".mcap", ".rrd", ".png"))
    yield mcap.name, McapSink(mcap)
    if options.rrd:
        yield rrd.name, RerunSink(rrd)
    if episode == 0 and importlib.util.find_spec("matplotlib") is not None:
        from egovcp.log.picture import PictureSink

        yield png.name, PictureSink(png)
    if options.live:
        live = stack.enter_context(LiveRerun.of(options.live))
        if live.page:
            print(f"look at it: {live.page}")
        yield "Rerun", RerunSink(live.viewer)


def run_info(
    task: str,
    seed: int,
    episode: int,
    camera: CameraView,
    config: Mapping[str, Any],
    controller_id: str,
    artefact: Artefact | None,
) -> RunInfo:
    """The first record of a log. ``config`` holds JSON values."""
    files = artefact.manifest["files"] if artefact else {}
    return RunInfo(
        task=task,
        seed=seed,
        episode=episode,
        camera=camera,
        config=config,
        hashes={"low_level_controller": controller_id, **files},
        versions=versions(),
    )
