"""Writes a Rerun recording: robot and scene in 3D, depth images, plans, and curves.

Ticks are sent in batches, which take about as many calls as one tick. A killed process loses up to
one batch (an MCAP file loses none).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from egovcp.errors import EnvironmentFailure
from egovcp.log import paths
from egovcp.log.blueprint import blueprint, signals_blueprint
from egovcp.log.meshes import LEFT, OBSTACLE, RIGHT, SPHERE, LinkMesh, link_meshes
from egovcp.log.pose import robot_poses
from egovcp.log.rerun_columns import (
    Columns,
    Frame,
    common_columns,
    g1_columns,
    log_value_map_styles,
    skeleton_columns,
)
from egovcp.log.signals import log_motor_styles, log_styles, motor_columns, signal_columns
from egovcp.log.tick import CameraView, RunInfo, Tick, existing_file_error
from egovcp.log.viewer import Viewer
from egovcp.robot_spec import G1, RobotSpec
from egovcp.spec import DEPTH_COLS, DEPTH_ROWS, Solid

BATCH_TICKS: Final = 25  # one second
LIVE_BATCH_TICKS: Final = 3  # for a low delay
_VIEWER_TIMEOUT_S: Final = 10.0
_DISK_TIMEOUT_S: Final = 60.0


class RerunSink:
    """Sends ticks to a Rerun file or viewer.

    A viewer may end or hang: wrap the sink in an `AsyncSink`, which does not wait for it.

    Args:
        destination: path of the ``.rrd`` file to create, or a viewer. `open` raises
            `EnvironmentFailure` if the file exists or no viewer listens.
        meshes: draw the meshes of the links if the model is installed, else a skeleton.
        signals: show curves of action and proprioception instead of plans and values, for
            recordings without a planner.
    """

    def __init__(
        self,
        destination: Path | Viewer,
        meshes: bool = True,
        signals: bool = False,
    ) -> None:
        self._destination = destination
        live = isinstance(destination, Viewer)
        self._timeout_s = _VIEWER_TIMEOUT_S if live else _DISK_TIMEOUT_S
        self._batch_ticks = LIVE_BATCH_TICKS if live else BATCH_TICKS
        self._wants_meshes = meshes
        self._meshes: dict[str, LinkMesh] = {}
        self._signals = signals
        self._faulty_joints: set[int] = set()
        self._batch: list[Tick] = []
        self._known: set[str] = set()
        self._stream: rr.RecordingStream | None = None
        self._failed = False

    def open(self, info: RunInfo) -> None:
        """Start the recording and log static data."""
        self._view, self._robot = info.camera, info.robot
        name = f"{info.task} seed {info.seed} episode {info.episode}"
        stream = rr.RecordingStream("egovcp")
        self._planned = info.robot.is_g1 and not self._signals
        layout = blueprint() if self._planned else signals_blueprint(info.robot)
        if isinstance(self._destination, Viewer):
            self._destination.attach(stream, layout)
        else:
            _create_file(self._destination, stream, layout)
        stream.send_recording_name(name)
        self._stream = stream
        _log_static(stream, info)
        if self._planned:
            log_value_map_styles(stream)
            log_motor_styles(stream)
        else:
            log_styles(stream, info.robot)
        self._meshes = link_meshes() if self._wants_meshes and info.robot.is_g1 else {}
        for link, mesh in self._meshes.items():
            surface = rr.Mesh3D(
                vertex_positions=mesh.vertices,
                triangle_indices=mesh.triangles,
                vertex_normals=mesh.normals,
                vertex_colors=mesh.colours,
            )
            stream.log(f"{paths.ROBOT}/{link}", surface, static=True)

    def write(self, tick: Tick) -> None:
        """Add the tick to the batch; send a full batch."""
        self._batch.append(tick)
        if len(self._batch) >= self._batch_ticks:
            self._send()

    def close(self) -> None:
        if self._stream is None or self._failed:
            return
        self._send()
        self._stream.disconnect()
        self._stream = None

    def _send(self) -> None:
        """Send the batch, and wait until it is written."""
        assert self._stream is not None, "open the sink before writing to it"
        for thing in (thing for tick in self._batch for thing in tick.scene):
            if thing.name not in self._known:
                self._known.add(thing.name)
                self._stream.log(f"{paths.SCENE}/{thing.name}", _shape(thing), static=True)
        for path, ticks, columns in self._columns() if self._batch else ():
            if ticks:
                self._stream.send_columns(path, _times(ticks), columns)
        self._batch.clear()
        try:
            self._stream.flush(timeout_sec=self._timeout_s)
        except RuntimeError as error:
            self._failed = True
            raise EnvironmentFailure(
                f"cannot send the recording: disk full, or viewer closed ({error})"
            ) from error

    def _columns(self) -> list[Columns]:
        """All columns of the batch."""
        groups = [*common_columns(self._batch)]
        if self._robot.is_g1:
            poses = robot_poses(self._batch)
            frames = [Frame(*pair) for pair in zip(self._batch, poses, strict=True)]
            groups += g1_columns(frames, self._view)
            if not self._meshes:
                groups.append(skeleton_columns(frames))
        if self._planned:
            groups += motor_columns(self._batch, self._faulty_joints)
        else:
            groups += signal_columns(self._batch, self._robot)
        return groups


def _create_file(path: Path, stream: rr.RecordingStream, layout: rrb.Blueprint) -> None:
    if path.exists():
        raise existing_file_error(path)
    try:
        stream.save(path, default_blueprint=layout)
    except RuntimeError as error:  # Rerun has no other type for it
        raise EnvironmentFailure(f"cannot create {path}: {error}") from error


def _times(ticks: Sequence[Tick]) -> list[rr.TimeColumn]:
    durations = np.array([tick.time_ns for tick in ticks], "timedelta64[ns]")
    return [
        rr.TimeColumn("tick", sequence=[tick.index for tick in ticks]),
        rr.TimeColumn("time", duration=durations),
    ]


def _shape(thing: Solid) -> rr.Boxes3D | rr.Ellipsoids3D:
    if thing.shape == "sphere":
        return rr.Ellipsoids3D(half_sizes=[thing.size], colors=[SPHERE], fill_mode="solid")
    return rr.Boxes3D(half_sizes=[thing.size], colors=[OBSTACLE], fill_mode="solid")


def _log_static(stream: rr.RecordingStream, info: RunInfo) -> None:
    stream.log(paths.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if info.robot.is_g1:
        stream.log(paths.CAMERA, _pinhole(info.camera), static=True)
    imagined = [f"{paths.IMAGINED}/{i}" for i in range(len(paths.IMAGINED_TICKS))]
    for path in (paths.DEPTH, paths.RECONSTRUCTED, *imagined):
        stream.log(path, depth_style(info.robot), static=True)
    hands = rr.Points3D.from_fields(colors=[LEFT, RIGHT], radii=[0.03], show_labels=False)
    stream.log(paths.HAND_TARGETS, hands, static=True)
    stream.log(paths.CANDIDATES, rr.LineStrips3D.from_fields(radii=[0.003]), static=True)
    best = rr.LineStrips3D.from_fields(colors=[LEFT, RIGHT], radii=[0.008])
    stream.log(paths.BEST, best, static=True)
    record = asdict(info)
    record["robot"] = info.robot.robot_type
    text = json.dumps(record, indent=2, sort_keys=True)
    document = rr.TextDocument(f"```json\n{text}\n```", media_type="text/markdown")
    stream.log(paths.INFO, document, static=True)


def _pinhole(view: CameraView) -> rr.Pinhole:
    return rr.Pinhole(
        focal_length=view.focal_px,
        principal_point=view.centre_px,
        width=DEPTH_COLS,
        height=DEPTH_ROWS,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.15,
    )


def depth_style(robot: RobotSpec = G1) -> rr.DepthImage:
    """Format and colour scale of all depth images."""
    rows, cols = robot.depth
    return rr.DepthImage.from_fields(
        format=rr.components.ImageFormat(
            width=cols,
            height=rows,
            channel_datatype=rr.ChannelDatatype.U16,
            color_model=rr.ColorModel.L,
        ),
        meter=1000.0,
        colormap=rr.components.Colormap.Turbo,
        depth_range=[0.0, robot.depth_max_m * 1000.0],
    )
