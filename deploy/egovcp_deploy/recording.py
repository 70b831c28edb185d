"""What a run leaves behind: its log, and what describes it at the beginning of each log."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from egovcp.artefact import Artefact
from egovcp.log.info import CameraView, RunInfo
from egovcp.log.mcap import McapSink
from egovcp.log.rerun import RerunSink
from egovcp.log.sink import Fanout, Sink
from egovcp_deploy.options import versions


@contextmanager
def recording(folder: Path, episode: int, info: RunInfo) -> Iterator[Sink]:
    """Sinks of one rollout; the first rollout leaves a picture too."""
    stem = folder / f"rollout-{episode}"
    sinks: list[Sink] = [McapSink(stem.with_suffix(".mcap")), RerunSink(stem.with_suffix(".rrd"))]
    if episode == 0 and importlib.util.find_spec("matplotlib") is not None:
        from egovcp.log.picture import PictureSink

        sinks.append(PictureSink(stem.with_suffix(".png")))
    with Fanout(sinks) as sink:
        sink.open(info)
        yield sink


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
