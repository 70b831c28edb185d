"""Value maps as pictures: x to the right, z up, the best yellow; a dot where the plan goes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from egovcp.log import paths
from egovcp.log.colour import SPHERE, value_colours
from egovcp.log.tick import Hand, Tick, ValueMap
from egovcp.spec import ACTION_BOX

HANDS: Final[tuple[Hand, ...]] = ("left", "right")
_FIRST: Final = {"left": 0, "right": 3}  # of the hand's x, y, z in an action


def log_value_map_styles(stream: rr.RecordingStream) -> None:
    """How the plan's target is drawn, once per recording."""
    for hand in HANDS:
        dot = rr.Points2D.from_fields(colors=[SPHERE], radii=[0.6], draw_order=1.0)
        stream.log(f"{paths.VALUE_MAP}/{hand}/{paths.CHOSEN}", dot, static=True)


def value_map_columns(ticks: Sequence[Tick]) -> Iterator[tuple[str, Sequence[Tick], Any]]:
    """(entity, ticks that have it, columns) of both hands' maps."""
    for hand in HANDS:
        found = [(tick, m) for tick in ticks for m in tick.value_maps if m.hand == hand]
        if found:
            shown = [tick for tick, _ in found]
            path = f"{paths.VALUE_MAP}/{hand}"
            yield path, shown, _pictures([m for _, m in found])
            points = np.array([chosen_pixel(tick, m) for tick, m in found])
            yield f"{path}/{paths.CHOSEN}", shown, rr.Points2D.columns(positions=points)


def _pictures(maps: Sequence[ValueMap]) -> Any:
    formats = [
        rr.components.ImageFormat(
            width=m.values.shape[1],
            height=m.values.shape[0],
            color_model=rr.ColorModel.RGB,
            channel_datatype=rr.ChannelDatatype.U8,
        )
        for m in maps
    ]
    return rr.Image.columns(buffer=[picture(m).ravel() for m in maps], format=formats)


def picture(value_map: ValueMap) -> NDArray[np.uint8]:
    """(n, m, 3) RGB, the top row the highest z."""
    values = value_map.values[::-1]
    return value_colours(values.ravel()).reshape(*values.shape, 3)


def chosen_pixel(tick: Tick, value_map: ValueMap) -> tuple[float, float]:
    """Column and row of the picture at which the planned action puts the hand."""
    first = _FIRST[value_map.hand]
    target = ACTION_BOX.to_metric(np.asarray(tick.action_planned))[first : first + 3]
    column = np.interp(target[0], value_map.x_b, np.arange(len(value_map.x_b)))
    row = np.interp(target[2], value_map.z_b, np.arange(len(value_map.z_b)))
    return float(column) + 0.5, len(value_map.z_b) - 0.5 - float(row)
