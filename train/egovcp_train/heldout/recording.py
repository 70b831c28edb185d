"""The open-loop predictions of a report as a Rerun recording, to be played ahead in time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.model.depth import to_metres
from egovcp.packages import is_installed
from egovcp.spec import PLANNER_DT
from egovcp_train.heldout.report import Report
from egovcp_train.heldout.strips import STRIP

if TYPE_CHECKING:
    import rerun.blueprint as rrb

RECORDING: Final = "open_loop.rrd"
_SEEN: Final = "seen"
_FORESEEN: Final = "foreseen"


def record(report: Report, folder: Path, depth_max_m: float) -> Path | None:
    """Write ``FOLDER/open_loop.rrd``: depth seen beside depth foreseen, per task.

    Entities ``/TASK/NUMBER/seen`` and ``.../foreseen``, in mm, on the timelines ``ticks_ahead``
    and ``time_ahead``. The one of an earlier report is replaced.

    Returns:
        The file; None where rerun is not installed, or the episodes are too short to foresee.
    """
    if not is_installed("rerun") or not any(report.strips.values()):
        return None
    import rerun as rr  # half a second

    from egovcp.log.rerun import depth_style

    path = folder / RECORDING
    stream = rr.RecordingStream("egovcp_open_loop")
    stream.save(path, default_blueprint=_look(report))
    ahead = [
        rr.TimeColumn("ticks_ahead", sequence=STRIP),
        rr.TimeColumn("time_ahead", duration=[k * PLANNER_DT for k in STRIP]),
    ]
    for task, found in report.strips.items():
        for number, strip in enumerate(found):
            for what, near in ((_SEEN, strip.seen), (_FORESEEN, strip.foreseen)):
                entity = f"/{task}/{number}/{what}"
                stream.log(entity, depth_style(), static=True)
                columns = rr.DepthImage.columns(buffer=_buffers(near, depth_max_m))
                stream.send_columns(entity, ahead, columns)
    stream.flush()
    stream.disconnect()
    return path


def _buffers(near: NDArray[np.float32], depth_max_m: float) -> list[NDArray[np.uint8]]:
    """(n, 48, 64) nearness -> n pictures in uint16 mm, as bytes."""
    from egovcp.log.messages import to_millimetres

    metres = to_metres(torch.from_numpy(near), depth_max_m).numpy()
    return [np.ascontiguousarray(to_millimetres(m)).view(np.uint8).ravel() for m in metres]


def _look(report: Report) -> rrb.Blueprint:
    """A tab per task; seen beside foreseen, one line per prediction; played in a loop."""
    import rerun.blueprint as rrb

    tabs = []
    for task, found in report.strips.items():
        lines = []
        for number, strip in enumerate(found):
            views = [
                rrb.Spatial2DView(
                    name=f"{what}, from row {strip.start}", origin=f"/{task}/{number}/{what}"
                )
                for what in (_SEEN, _FORESEEN)
            ]
            lines.append(rrb.Horizontal(*views))
        tabs.append(rrb.Vertical(*lines, name=task))
    time = rrb.TimePanel(
        state="collapsed", timeline="time_ahead", play_state="playing", loop_mode="all"
    )
    return rrb.Blueprint(rrb.Tabs(*tabs), time, collapse_panels=True)
