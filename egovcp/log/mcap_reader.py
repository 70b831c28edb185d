"""Reads a recorded run back: what `McapSink` wrote, also from a file that was cut short."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from egovcp.errors import DataError
from egovcp.log.info import RunInfo
from egovcp.log.mcap import METADATA_NAME
from egovcp.log.messages import Topic
from egovcp.log.tick import BasePose, Candidates, SceneObject, Tick
from egovcp.spec import DEPTH_COLS

_FLAGS = ("terminated", "truncated", "success")


@dataclass(frozen=True)
class Recording:
    """One run as it was recorded."""

    info: RunInfo
    ticks: list[Tick]
    complete: bool
    """False when the file ends in the middle: the process died or the disk filled up."""


def read_recording(path: Path) -> Recording:
    """Read ``path`` up to its end, or up to where it was torn off.

    Raises:
        DataError: not an MCAP file, or not one of ours.
    """
    reader = _Reader()
    try:
        with path.open("rb") as file:
            complete = reader.consume(StreamReader(file).records)
    except FileNotFoundError as error:
        raise DataError(f"no recording at {path}; expected an MCAP file") from error
    except McapError as error:
        raise DataError(f"{path} is not an MCAP file: {error}") from error
    if reader.info is None:
        raise DataError(
            f"{path} has no metadata record {METADATA_NAME!r}; expected a recording of egovcp"
        )
    return Recording(reader.info, [_tick(i, t, m) for i, t, m in reader.groups], complete)


class _Reader:
    """Decodes records and groups messages by tick."""

    def __init__(self) -> None:
        self.info: RunInfo | None = None
        self.groups: list[tuple[int, int, dict[str, Any]]] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._factory = DecoderFactory()

    def consume(self, records: Iterator[McapRecord]) -> bool:
        """Take in every record; False if they stop before the end of the file."""
        try:
            for record in records:
                self._take(record)
        except (EndOfFile, struct.error):
            return False
        return True

    def _take(self, record: McapRecord) -> None:
        if isinstance(record, Metadata) and record.name == METADATA_NAME:
            self.info = RunInfo.from_metadata(record.metadata)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Message):
            self._take_message(record)

    def _take_message(self, message: Message) -> None:
        if not self.groups or self.groups[-1][0] != message.sequence:
            self.groups.append((message.sequence, message.log_time, {}))
        channel = self._channels[message.channel_id]
        schema = self._schemas[channel.schema_id]
        decode = self._factory.decoder_for(channel.message_encoding, schema)
        if decode is not None:
            self.groups[-1][2][channel.topic] = decode(message.data)


def _tick(index: int, time_ns: int, messages: Mapping[str, Any]) -> Tick:
    """The inverse of `messages.encode_tick`; decoded depths come back in whole millimetres."""
    reward = _scalars(messages[Topic.REWARD])
    plan = _scalars(messages.get(Topic.PLAN_SCALARS))
    flags = {name: bool(reward.pop(name)) for name in _FLAGS}
    total = reward.pop("reward")
    log = messages.get(Topic.LOG)
    return Tick(
        index=index,
        time_ns=time_ns,
        depth=_image(messages[Topic.DEPTH]),
        state=_array(messages[Topic.STATE]).astype(np.float32),
        action_planned=_array(messages[Topic.ACTION_PLANNED]).astype(np.float32),
        action_sent=_array(messages[Topic.ACTION]).astype(np.float32),
        depth_reconstructed=_metres(messages.get(Topic.RECONSTRUCTED)),
        depth_imagined=_film(messages.get(Topic.IMAGINED)),
        plan=_array(messages[Topic.PLAN]) if Topic.PLAN in messages else None,
        candidates=_candidates(messages.get(Topic.CANDIDATES)),
        value=plan.get("value"),
        termination=plan.get("termination"),
        reward=total,
        reward_terms=reward,
        timing_ms=_scalars(messages.get(Topic.TIMING)),
        base=_base(messages.get(Topic.BASE)),
        scene=_scene(messages.get(Topic.SCENE)),
        events=tuple(log.msg.split("\n")) if log else (),
        terminated=flags["terminated"],
        truncated=flags["truncated"],
        success=flags["success"],
    )


def _array(message: Any) -> NDArray[np.float64]:
    shape = [dimension.size for dimension in message.layout.dim]
    return np.array(message.data, np.float64).reshape(shape)


def _scalars(message: Any) -> dict[str, float]:
    if message is None:
        return {}
    names = message.layout.dim[0].label.split(",")
    return dict(zip(names, map(float, message.data), strict=True))


def _image(message: Any) -> NDArray[np.uint16]:
    return np.frombuffer(message.data, "<u2").reshape(message.height, message.width)


def _metres(message: Any) -> NDArray[np.float64] | None:
    return None if message is None else _image(message) / 1000.0


def _film(message: Any) -> NDArray[np.float64] | None:
    strip = _metres(message)
    return None if strip is None else np.stack(np.split(strip, strip.shape[1] // DEPTH_COLS, 1))


def _candidates(message: Any) -> Candidates | None:
    if message is None:
        return None
    points = np.frombuffer(message.data, "<f4").reshape(message.height, -1, 2, 4)
    return Candidates(hands_b=points[..., :3], values=points[:, 0, 0, 3])


def _base(message: Any) -> BasePose | None:
    if message is None:
        return None
    p, q = message.pose.position, message.pose.orientation
    return BasePose(np.array([p.x, p.y, p.z]), np.array([q.w, q.x, q.y, q.z]))


def _scene(message: SimpleNamespace | None) -> tuple[SceneObject, ...]:
    if message is None:
        return ()
    names = [label.split(":") for label in message.layout.dim[0].label.split(",")]
    rows = _array(message).tolist()
    return tuple(
        SceneObject(name, "sphere" if shape == "sphere" else "box", *_split(row))
        for (name, shape), row in zip(names, rows, strict=True)
    )


type _Triple = tuple[float, float, float]


def _split(row: list[float]) -> tuple[_Triple, tuple[float, float, float, float], _Triple]:
    x, y, z, qw, qx, qy, qz, sx, sy, sz = row
    return (x, y, z), (qw, qx, qy, qz), (sx, sy, sz)
