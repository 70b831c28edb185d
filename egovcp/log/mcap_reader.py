"""Reads a recorded run back: what `McapSink` wrote, also from a file that was cut short.

Moment by moment, so that an hour takes no more memory than a second::

    reader = RecordingReader(path)
    for moment in reader.moments():
        moment.tick()
    reader.complete  # False: the file was torn
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from egovcp.errors import DataError
from egovcp.log.info import RunInfo
from egovcp.log.mcap import METADATA_NAME, Line
from egovcp.log.messages import VALUE_MAPS, Topic
from egovcp.log.tick import BasePose, Candidates, MotorReadings, SceneObject, Tick, ValueMap
from egovcp.spec import DEPTH_COLS

_FLAGS = ("terminated", "truncated", "success")
_MAGIC: Final = b"\x89MCAP0\r\n"
#: What is left of a record where a file was torn can go wrong in any of these ways.
_TORN: Final = (
    McapError,
    struct.error,
    ValueError,
    OverflowError,
    MemoryError,
    zstandard.ZstdError,
)
#: What a row of a dataset needs of a tick.
ROW_TOPICS: Final = frozenset(
    {Topic.DEPTH, Topic.STATE, Topic.ACTION, Topic.REWARD, Topic.MODE, Topic.LOG}
)
_MOTOR_TOPICS: Final = frozenset({Topic.JOINTS, Topic.MOTOR_TEMPERATURE, Topic.MOTOR_STATUS})


@dataclass(frozen=True)
class Recording:
    """One run as it was recorded."""

    info: RunInfo
    ticks: list[Tick]
    complete: bool
    """False when the file ends in the middle: the process died or the disk filled up."""


def read_recording(path: Path) -> Recording:
    """Read ``path`` into memory, up to its end, or up to where it was torn off.

    Raises:
        DataError: not an MCAP file, or not one of ours.
    """
    reader = RecordingReader(path)
    ticks = [moment.tick() for moment in reader.moments()]
    return Recording(reader.info, ticks, reader.complete)


@dataclass
class Moment:
    """The messages of one tick, not decoded."""

    index: int
    time_ns: int
    lines: Mapping[str, Line]
    decoders: DecoderFactory
    """Of this file: it remembers them by the numbers that the file gives its schemas."""
    messages: dict[str, Message] = field(default_factory=dict)

    def tick(self, topics: Collection[str] | None = None) -> Tick:
        """Decode the tick, or only those of its parts that are on ``topics``.

        Raises:
            DataError: it lacks what every tick has, or a message is damaged.
        """
        wanted = self.messages.keys() if topics is None else self.messages.keys() & set(topics)
        try:
            return _tick(self.index, self.time_ns, {name: self._decode(name) for name in wanted})
        except KeyError as error:
            raise DataError(f"tick {self.index} has nothing on topic {error.args[0]}") from error
        except (struct.error, ValueError, IndexError, AttributeError) as error:
            raise DataError(f"tick {self.index} is damaged: {error}") from error

    def text(self, topic: str) -> str:
        """The words on ``topic``, a log; empty where there are none."""
        return str(self._decode(topic).msg) if topic in self.messages else ""

    def mode(self) -> str:
        """`Tick.mode`.

        Raises:
            DataError: the message is damaged.
        """
        return _mode(self._decoded({Topic.MODE}).get(Topic.MODE))

    def motors(self) -> MotorReadings | None:
        """`Tick.motors`.

        Raises:
            DataError: a message is damaged.
        """
        try:
            return motor_readings(self._decoded(_MOTOR_TOPICS))
        except (ValueError, IndexError, AttributeError) as error:
            raise DataError(f"tick {self.index} is damaged: {error}") from error

    def _decoded(self, topics: Collection[str]) -> dict[str, Any]:
        """Topic -> decoded message, of those of ``topics`` that the tick has."""
        try:
            return {name: self._decode(name) for name in self.messages.keys() & set(topics)}
        except (struct.error, ValueError, IndexError, AttributeError) as error:
            raise DataError(f"tick {self.index} is damaged: {error}") from error

    def _decode(self, topic: str) -> Any:
        line = self.lines[topic]
        decode = self.decoders.decoder_for(line.encoding, line.schema)
        if decode is None:
            raise DataError(f"topic {topic} is {line.schema.name} in {line.encoding}, not ROS 2")
        return decode(self.messages[topic].data)


class RecordingReader:
    """Goes through a recording once, up to its end, or to where it was torn off.

    Raises:
        DataError: not an MCAP file, or not one of ours.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        _require_mcap(path)
        self.complete = False
        """Whether `moments` has come to the end that the writer gave the file."""
        self.lines: dict[str, Line] = {}
        """The topics met so far."""
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._decoders = DecoderFactory()
        self._records = self._read()
        self.metadata = self._first_metadata()
        """The record ``egovcp`` as it stands in the file."""
        self.info = self._info()

    def moments(self) -> Iterator[Moment]:
        """The ticks in order, once."""
        moment: Moment | None = None
        for record in self._records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._add_channel(record)
            elif isinstance(record, Message):
                if moment is None or moment.index != record.sequence:
                    if moment is not None:
                        yield moment
                    moment = self._moment(record)
                moment.messages[self._channels[record.channel_id].topic] = record
        if moment is not None:
            yield moment

    def _moment(self, first: Message) -> Moment:
        return Moment(first.sequence, first.log_time, self.lines, self._decoders)

    def _add_channel(self, channel: Channel) -> None:
        self._channels[channel.id] = channel
        schema = self._schemas[channel.schema_id]
        self.lines[channel.topic] = Line(channel.topic, schema, channel.message_encoding)

    def _read(self) -> Iterator[McapRecord]:
        """Every record that is whole and belongs to what was read before."""
        with self._path.open("rb") as file:
            limit = self._path.stat().st_size  # no record is longer than its file
            reader = StreamReader(file, validate_crcs=True, record_size_limit=limit)
            try:
                for record in reader.records:
                    if self._is_orphan(record):
                        return
                    yield record
            except _TORN:
                return
            self.complete = True

    def _is_orphan(self, record: McapRecord) -> bool:
        if isinstance(record, Message):
            return record.channel_id not in self._channels
        return isinstance(record, Channel) and record.schema_id not in self._schemas

    def _first_metadata(self) -> Mapping[str, str]:
        """The metadata record, which comes before any tick."""
        for record in self._records:
            if isinstance(record, Metadata) and record.name == METADATA_NAME:
                return record.metadata
            if isinstance(record, Message | Channel | Schema):
                break
        raise DataError(
            f"{self._path} has no metadata record {METADATA_NAME!r} before its first message; "
            "expected a recording of egovcp"
        )

    def _info(self) -> RunInfo:
        try:
            return RunInfo.from_metadata(self.metadata)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            problem = f"its metadata record {METADATA_NAME!r} is damaged: {error!r}"
            raise DataError(f"{self._path}: {problem}") from error


def _require_mcap(path: Path) -> None:
    """Raise `DataError` for what does not begin like an MCAP file."""
    try:
        with path.open("rb") as file:
            start = file.read(len(_MAGIC))
    except FileNotFoundError as error:
        raise DataError(f"no recording at {path}; expected an MCAP file") from error
    except IsADirectoryError as error:
        raise DataError(f"{path} is a folder; expected an MCAP file") from error
    if start != _MAGIC:
        found = "is empty" if not start else f"begins with {start!r}"
        raise DataError(f"{path} {found}; expected an MCAP file")


def _tick(index: int, time_ns: int, messages: Mapping[str, Any]) -> Tick:
    """The inverse of `messages.encode_tick`; decoded depths come back in whole millimetres."""
    reward = _scalars(messages[Topic.REWARD])
    plan = _scalars(messages.get(Topic.PLAN_SCALARS))
    flags = {name: bool(reward.pop(name)) for name in _FLAGS}
    total = reward.pop("reward")
    log = messages.get(Topic.LOG)
    sent = _array(messages[Topic.ACTION]).astype(np.float32)
    planned = messages.get(Topic.ACTION_PLANNED)
    return Tick(
        index=index,
        time_ns=time_ns,
        depth=_image(messages[Topic.DEPTH]),
        state=_array(messages[Topic.STATE]).astype(np.float32),
        action_planned=sent if planned is None else _array(planned).astype(np.float32),
        action_sent=sent,
        depth_reconstructed=_metres(messages.get(Topic.RECONSTRUCTED)),
        depth_imagined=_film(messages.get(Topic.IMAGINED)),
        plan=_array(messages[Topic.PLAN]) if Topic.PLAN in messages else None,
        candidates=_candidates(messages.get(Topic.CANDIDATES)),
        value=plan.get("value"),
        termination=plan.get("termination"),
        value_maps=_value_maps(messages),
        reward=total,
        reward_terms=reward,
        timing_ms=_scalars(messages.get(Topic.TIMING)),
        base=_base(messages.get(Topic.BASE)),
        scene=_scene(messages.get(Topic.SCENE)),
        events=tuple(log.msg.split("\n")) if log else (),
        mode=_mode(messages.get(Topic.MODE)),
        motors=motor_readings(messages),
        link=_scalars(messages.get(Topic.LINK)),
        terminated=flags["terminated"],
        truncated=flags["truncated"],
        success=flags["success"],
    )


def motor_readings(messages: Mapping[str, Any]) -> MotorReadings | None:
    """From the decoded messages of a tick, topic -> message; None: no torque was recorded."""
    joints = messages.get(Topic.JOINTS)
    if joints is None or not len(joints.effort):
        return None
    temperature = messages.get(Topic.MOTOR_TEMPERATURE)
    status = _rows(messages.get(Topic.MOTOR_STATUS))
    return MotorReadings(
        torque=np.array(joints.effort, np.float64),
        temperature=None if temperature is None else _array(temperature).T,
        faults=_integers(status.get("faults")),
        lost=_integers(status.get("lost")),
        enabled=None if "enabled" not in status else status["enabled"] != 0.0,
    )


def _rows(message: Any) -> dict[str, NDArray[np.float64]]:
    """Label -> row of a matrix."""
    if message is None:
        return {}
    names = message.layout.dim[0].label.split(",")
    return dict(zip(names, _array(message), strict=True))


def _integers(row: NDArray[np.float64] | None) -> NDArray[np.int64] | None:
    return None if row is None else row.astype(np.int64)


def _array(message: Any) -> NDArray[np.float64]:
    shape = [dimension.size for dimension in message.layout.dim]
    return np.array(message.data, np.float64).reshape(shape)


def _scalars(message: Any) -> dict[str, float]:
    if message is None:
        return {}
    names = message.layout.dim[0].label.split(",")
    return dict(zip(names, map(float, message.data), strict=True))


def _mode(message: Any) -> str:
    return "".join(name for name, is_in in _scalars(message).items() if is_in)


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


def _value_maps(messages: Mapping[str, Any]) -> tuple[ValueMap, ...]:
    maps = []
    for hand, topic in VALUE_MAPS.items():
        if topic in messages:
            message = messages[topic]
            cloud = np.frombuffer(message.data, "<f4").reshape(message.height, message.width, 4)
            x, z, y = cloud[0, :, 0], cloud[:, 0, 2], float(cloud[0, 0, 1])
            maps.append(ValueMap(hand, x, y, z, cloud[..., 3]))
    return tuple(maps)


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
