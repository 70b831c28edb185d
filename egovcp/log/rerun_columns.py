"""Converts batches of ticks to Rerun columns: few calls for many ticks, below 1 ms per tick.

Each function takes the ticks of one batch and yields `Columns`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from egovcp.log import paths
from egovcp.log.meshes import SPHERE, value_colours
from egovcp.log.messages import to_millimetres
from egovcp.log.pose import RobotPose
from egovcp.log.tick import CameraView, Hand, Tick, ValueMap
from egovcp.robot.geometry import quaternion
from egovcp.robot.kinematics import LINK_NAMES, PARENT, WRISTS
from egovcp.spec import ACTION_BOX, ACTION_HANDS, STATE_SLICES, Solid

Array = NDArray[np.floating]

HANDS: Final[tuple[Hand, ...]] = ("left", "right")


class Frame(NamedTuple):
    """A tick with its forward kinematics."""

    tick: Tick
    pose: RobotPose


class Columns(NamedTuple):
    """Values of one entity at the ticks that have them."""

    path: str
    ticks: Sequence[Tick]
    columns: Iterable[Any]


def common_columns(ticks: Sequence[Tick]) -> Iterator[Columns]:
    """What changes with time for every robot."""
    yield from _depths(ticks)
    yield from _scene(ticks)
    yield from _scalars(ticks)
    yield from _events(ticks)


def g1_columns(frames: Sequence[Frame], view: CameraView) -> Iterator[Columns]:
    """What also changes with time for the G1, whose links are known."""
    yield from _robot(frames)
    yield _camera(frames, view)
    yield from _plans(frames)
    yield from _value_maps([frame.tick for frame in frames])


def _poses(positions: Array, quaternions_wxyz: Array) -> Iterable[Any]:
    """(n, 3) and (n, 4): Rerun orders quaternions x, y, z, w."""
    return rr.Transform3D.columns(
        translation=positions, quaternion=np.asarray(quaternions_wxyz)[:, [1, 2, 3, 0]]
    )


def _robot(frames: Sequence[Frame]) -> Iterator[Columns]:
    ticks = [frame.tick for frame in frames]
    positions = np.stack([frame.pose.positions_w for frame in frames])
    quaternions = np.stack([frame.pose.quaternions_w for frame in frames])
    for i, link in enumerate(LINK_NAMES):
        columns = _poses(positions[:, i], quaternions[:, i])
        yield Columns(f"{paths.ROBOT}/{link}", ticks, columns)
    targets = [
        f.pose.from_heading(f.tick.state[STATE_SLICES["command_hands"]].reshape(2, 3))
        for f in frames
    ]
    points = rr.Points3D.columns(positions=np.concatenate(targets)).partition([2] * len(ticks))
    yield Columns(paths.HAND_TARGETS, ticks, points)


def skeleton_columns(frames: Sequence[Frame]) -> Columns:
    """The robot as line strips between joints, for a machine without meshes."""
    strips = np.concatenate([skeleton(frame.pose) for frame in frames])
    count = len(strips) // len(frames)
    columns = rr.LineStrips3D.columns(strips=strips).partition([count] * len(frames))
    return Columns(paths.SKELETON, [frame.tick for frame in frames], columns)


def skeleton(pose: RobotPose) -> Array:
    """(n, 2, 3) lines from each link to its parent, and from each wrist to its palm."""
    p = pose.positions_w
    bones = [p[[parent, child]] for child, parent in enumerate(PARENT) if parent >= 0]
    hands = [np.stack([p[w], palm]) for w, palm in zip(WRISTS, pose.palms_w, strict=True)]
    return np.stack(bones + hands)


def _camera(frames: Sequence[Frame], view: CameraView) -> Columns:
    poses = [frame.pose.camera(view) for frame in frames]
    quaternions = quaternion(np.stack([rotation for _, rotation in poses]))
    columns = _poses(np.stack([position for position, _ in poses]), quaternions)
    return Columns(paths.CAMERA, [frame.tick for frame in frames], columns)


def _depths(ticks: Sequence[Tick]) -> Iterator[Columns]:
    yield _images(paths.DEPTH, [(tick, tick.depth) for tick in ticks])
    decoded = [(t, t.depth_reconstructed) for t in ticks if t.depth_reconstructed is not None]
    yield _images(paths.RECONSTRUCTED, [(tick, to_millimetres(image)) for tick, image in decoded])
    strips = [(tick, tick.depth_imagined) for tick in ticks if tick.depth_imagined is not None]
    for i, k in enumerate(paths.IMAGINED_TICKS):
        shown = [
            (tick, to_millimetres(images[k - 1])) for tick, images in strips if len(images) >= k
        ]
        yield _images(f"{paths.IMAGINED}/{i}", shown)


def _images(path: str, shown: Sequence[tuple[Tick, NDArray[np.uint16]]]) -> Columns:
    buffers = [np.ascontiguousarray(image).view(np.uint8).ravel() for _, image in shown]
    columns = rr.DepthImage.columns(buffer=buffers) if shown else ()
    return Columns(path, [tick for tick, _ in shown], columns)


def _plans(frames: Sequence[Frame]) -> Iterator[Columns]:
    weighed = [frame for frame in frames if frame.tick.candidates is not None]
    if weighed:
        yield _candidates(weighed)
    planned = [frame for frame in frames if frame.tick.plan is not None]
    if planned:
        strips = np.concatenate([_best(frame) for frame in planned])
        columns = rr.LineStrips3D.columns(strips=strips).partition([2] * len(planned))
        yield Columns(paths.BEST, [frame.tick for frame in planned], columns)


def _best(frame: Frame) -> Array:
    """(2, N, 3) path of each hand along the chosen plan, world frame."""
    hands = ACTION_BOX.to_metric(np.asarray(frame.tick.plan))[:, ACTION_HANDS].reshape(-1, 2, 3)
    return frame.pose.from_heading(hands).swapaxes(0, 1)


def _candidates(frames: Sequence[Frame]) -> Columns:
    strips, colours, counts = [], [], []
    for frame in frames:
        candidates = frame.tick.candidates
        assert candidates is not None
        hands = frame.pose.from_heading(candidates.hands_b)  # (n, N, 2, 3)
        strips += [hands[:, :, 0], hands[:, :, 1]]
        colours.append(np.tile(value_colours(candidates.values), (2, 1)))
        counts.append(2 * len(hands))
    # one array is ten times faster than a list of strips
    columns = rr.LineStrips3D.columns(strips=np.concatenate(strips), colors=np.concatenate(colours))
    return Columns(paths.CANDIDATES, [f.tick for f in frames], columns.partition(counts))


def _scene(ticks: Sequence[Tick]) -> Iterator[Columns]:
    seen: dict[str, list[tuple[Tick, Solid]]] = {}
    for tick in ticks:
        for thing in tick.scene:
            seen.setdefault(thing.name, []).append((tick, thing))
    for name, moments in seen.items():
        positions = np.array([thing.position_w for _, thing in moments])
        quaternions = np.array([thing.quaternion_w for _, thing in moments])
        columns = _poses(positions, quaternions)
        yield Columns(f"{paths.SCENE}/{name}", [tick for tick, _ in moments], columns)


def _scalars(ticks: Sequence[Tick]) -> Iterator[Columns]:
    for name in ("value", "termination"):
        known = [tick for tick in ticks if getattr(tick, name) is not None]
        values = [float(getattr(tick, name)) for tick in known]
        yield Columns(f"{paths.PLAN}/{name}", known, rr.Scalars.columns(scalars=values))
    yield from named_columns(
        paths.REWARD, ticks, lambda t: {"total": t.reward} | dict(t.reward_terms)
    )
    yield from named_columns(paths.TIMING, ticks, lambda tick: tick.timing_ms)


def named_columns(
    path: str, ticks: Sequence[Tick], scalars: Callable[[Tick], Mapping[str, float]]
) -> Iterator[Columns]:
    """One entity per name, so that every curve has a legend entry."""
    for name in dict.fromkeys(name for tick in ticks for name in scalars(tick)):
        known = [tick for tick in ticks if name in scalars(tick)]
        values = [float(scalars(tick)[name]) for tick in known]
        yield Columns(f"{path}/{name}", known, rr.Scalars.columns(scalars=values))


def _events(ticks: Sequence[Tick]) -> Iterator[Columns]:
    eventful = [tick for tick in ticks if tick.events]
    if eventful:
        lines = [line for tick in eventful for line in tick.events]
        counts = [len(tick.events) for tick in eventful]
        columns = rr.TextLog.columns(text=lines, level=["INFO"] * len(lines))
        yield Columns(paths.EVENTS, eventful, columns.partition(counts))


def log_value_map_styles(stream: rr.RecordingStream) -> None:
    """Log the style of the planned hand target, once per recording."""
    for hand in HANDS:
        dot = rr.Points2D.from_fields(colors=[SPHERE], radii=[0.6], draw_order=1.0)
        stream.log(f"{paths.VALUE_MAP}/{hand}/{paths.CHOSEN}", dot, static=True)


def _value_maps(ticks: Sequence[Tick]) -> Iterator[Columns]:
    """Value maps as images (x right, z up) with a dot at the planned hand target."""
    for hand in HANDS:
        found = [(tick, m) for tick in ticks for m in tick.value_maps if m.hand == hand]
        if found:
            shown = [tick for tick, _ in found]
            path = f"{paths.VALUE_MAP}/{hand}"
            yield Columns(path, shown, _map_images([m for _, m in found]))
            points = np.array([chosen_pixel(tick, m) for tick, m in found])
            yield Columns(f"{path}/{paths.CHOSEN}", shown, rr.Points2D.columns(positions=points))


def _map_images(maps: Sequence[ValueMap]) -> Any:
    formats = [
        rr.components.ImageFormat(
            width=m.values.shape[1],
            height=m.values.shape[0],
            color_model=rr.ColorModel.RGB,
            channel_datatype=rr.ChannelDatatype.U8,
        )
        for m in maps
    ]
    return rr.Image.columns(buffer=[map_image(m).ravel() for m in maps], format=formats)


def map_image(value_map: ValueMap) -> NDArray[np.uint8]:
    """(n, m, 3) RGB; the top row has the highest z."""
    values = value_map.values[::-1]
    return value_colours(values.ravel()).reshape(*values.shape, 3)


def chosen_pixel(tick: Tick, value_map: ValueMap) -> tuple[float, float]:
    """Column and row of the planned hand target in the image of a value map."""
    first = 3 * HANDS.index(value_map.hand)  # of the hand's x, y, z in an action
    target = ACTION_BOX.to_metric(np.asarray(tick.action_planned))[first : first + 3]
    column = np.interp(target[0], value_map.x_b, np.arange(len(value_map.x_b)))
    row = np.interp(target[2], value_map.z_b, np.arange(len(value_map.z_b)))
    return float(column) + 0.5, len(value_map.z_b) - 0.5 - float(row)
