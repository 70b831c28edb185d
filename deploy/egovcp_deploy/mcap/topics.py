"""Reads MCAP files of other recorders as rows of a LeRobot dataset: a file maps topics to features.

Messages are JSON or ROS 2 (CDR).
"""

from __future__ import annotations

import base64
import errno
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from egovcp.data.schema import INDEX_FEATURES
from egovcp.data.tiff import open_image
from egovcp.errors import DataError, UsageError
from egovcp.files import UnsafeFileError
from egovcp.flags import read_config
from egovcp.log.mcap_reader import require_mcap
from egovcp.log.mcap_records import MCAP_ERRORS
from egovcp.rate import NS_PER_S
from egovcp.values import build

type Array = NDArray[Any]

_OLDEST_PERIODS: Final = 2  # of the newest message of a topic at a row; older: a gap
_SLOWEST: Final = 0.66  # least rate of a topic, relative to that of the rows
_STEP: Final = re.compile(r"\.(\w+)|\[(\d+)\]")
#: Encoding of a raw image -> type of its pixels, channels, and which of them are R, G, B or depth.
_PIXELS: Final = {
    "rgb8": ("u1", 3, [0, 1, 2]),
    "bgr8": ("u1", 3, [2, 1, 0]),
    "rgba8": ("u1", 4, [0, 1, 2]),
    "bgra8": ("u1", 4, [2, 1, 0]),
    "mono8": ("u1", 1, [0, 0, 0]),
    **dict.fromkeys(("16UC1", "mono16"), ("u2", 1, [0])),
    "32FC1": ("f4", 1, [0]),
}


@dataclass(frozen=True)
class TopicMapping:
    """Topics -> features of a dataset, the content of the file of ``--mapping``."""

    fps: int
    """Rows per second."""
    task: str
    """Text of the task."""
    features: dict[str, list[str] | str]
    """Feature -> ``/topic.field``, or a list of them, whose values are joined. More fields and
    indices may follow, ``/joints.position[3]``. A message or field that has fields is an image,
    or all numbers in it."""
    names: dict[str, list[str]] = field(default_factory=dict)
    """Feature -> names of its values."""
    hold: list[str] = field(default_factory=list)
    """Topics with messages at changes only: the last one holds, whatever its age."""
    video: bool = False
    """Store images as videos, smaller but lossy."""

    @classmethod
    def read(cls, path: Path) -> TopicMapping:
        """Read a YAML or JSON file; raises `UsageError`."""
        try:
            found = build(cls, read_config(path), "")
            for key, sources in found.features.items():
                if key in (*INDEX_FEATURES, "", "task") or "/" in key:
                    raise ValueError(f"{key!r} cannot be the name of a feature; rename it")
                if not sources:
                    raise ValueError(f"features.{key} names no topic")
            if unknown := found.names.keys() - found.features.keys():
                raise ValueError(f"names has {sorted(unknown)}, which features has not")
            if found.fps < 1 or not found.features or not found.task:
                raise ValueError("expected fps of at least 1, a task, and features")
        except (OSError, UnsafeFileError, ValueError, UsageError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(f"--mapping={path}: {reason}") from error
        return found


class TopicRecording:
    """Rows of features at the rate of the mapping. A row has the newest message of each topic at
    its time (``log_time``); the first is at the first time at which all topics have one."""

    def __init__(self, path: Path, mapping: TopicMapping) -> None:
        """Read the times of all messages; raises `DataError` if the file is damaged, or lacks a
        topic, or one is too slow."""
        require_mcap(path)
        self.path, self._fps, self._decoders = path, mapping.fps, DecoderFactory()
        times: dict[str, list[int]] = {}
        for _, channel, message in self._messages(None):
            times.setdefault(channel.topic, []).append(message.log_time)
        self._times = {topic: np.array(found) for topic, found in times.items()}
        self._sources = {
            key: [self._split(source) for source in ([value] if isinstance(value, str) else value)]
            for key, value in mapping.features.items()
        }
        self._topics = {topic for parts in self._sources.values() for topic, _ in parts}
        held = {self._split(topic)[0] for topic in mapping.hold}
        self._paced = sorted(self._topics - held or self._topics)
        for topic in self._paced:
            periods = np.diff(self._times[topic])
            rate = NS_PER_S / max(float(np.median(periods)), 1.0) if len(periods) else 0.0
            if rate < _SLOWEST * self._fps:
                raise DataError(
                    f"{path}: {topic} has {rate:.3g} messages per second, but fps is {self._fps}; "
                    "lower fps, or list the topic under hold"
                )

    @cached_property
    def row_times(self) -> Array:
        """(T,) ns."""
        first = max(int(self._times[topic][0]) for topic in self._topics)
        last = min(int(self._times[topic][-1]) for topic in self._paced)
        if last < first:
            raise DataError(f"{self.path}: its mapped topics have no time in common")
        count = (last - first) * self._fps // NS_PER_S + 1
        return first + np.arange(count) * NS_PER_S // self._fps

    def gap(self) -> tuple[int, str]:
        """(Number of rows before the first gap, which message is missing there); without a gap:
        (number of all rows, "")."""
        rows, found = self.row_times, [(len(self.row_times), "")]
        for topic in self._paced:
            times = self._times[topic]
            following = np.searchsorted(times, rows, "right")
            late = (rows - times[following - 1]) * self._fps > _OLDEST_PERIODS * NS_PER_S
            if late.any():
                at = int(np.argmax(late))
                pause = (times[following[at]] - times[following[at] - 1]) / NS_PER_S
                found.append((at, f"nothing on {topic} for {pause:.2f} s before row {at}"))
        return min(found)

    def rows(self, shapes: dict[str, tuple[int, ...]]) -> Iterator[dict[str, Array]]:
        """The rows, feature -> image (H, W, C) or values (n,). ``shapes`` are those of earlier
        rows, which must be the same; the first row completes them. Raises `DataError` if a message
        cannot be decoded, lacks a field, or has another shape."""
        latest: dict[str, tuple[Schema | None, Channel, Message]] = {}
        messages = self._messages(self._topics)
        following = next(messages, None)
        for number, time in enumerate(self.row_times):
            while following is not None and following[2].log_time <= time:
                latest[following[1].topic] = following
                following = next(messages, None)
            try:
                decoded = {topic: self._decode(*found) for topic, found in latest.items()}
                row = {key: self._value(key, decoded) for key in self._sources}
                for key, value in row.items():
                    if value.shape != shapes.setdefault(key, value.shape):
                        raise DataError(f"{key} has shape {value.shape}, before {shapes[key]}")
                    if value.dtype.kind == "f" and not np.isfinite(value).all():
                        raise DataError(f"{key} is not finite")
            except DataError as error:
                raise DataError.at(self.path, str(error), frame=number) from error
            yield row

    def _value(self, key: str, decoded: Mapping[str, Any]) -> Array:
        parts = []
        for topic, steps in self._sources[key]:
            try:
                parts.append(_values(_part(decoded[topic], steps)))
            except (LookupError, TypeError, ValueError, DataError) as error:
                raise DataError(f"{key} from {topic}{steps}: {error}") from error
        if len(parts) > 1 and any(part.ndim > 1 for part in parts):
            raise DataError(f"{key} joins images; expected one image, or numbers")
        return np.concatenate(parts)

    def _decode(self, schema: Schema | None, channel: Channel, message: Message) -> Any:
        kind = channel.message_encoding
        try:
            decode = json.loads if kind == "json" else self._decoders.decoder_for(kind, schema)
            if decode is not None:
                return decode(message.data)
        except Exception as error:  # decoders raise many types on damaged schemas and messages
            raise DataError(f"{channel.topic} is damaged: {error!r}") from error
        found = f"{kind} ({schema.name})" if schema else kind
        raise DataError(f"{channel.topic} is {found}; expected JSON or ROS 2 (cdr)")

    def _messages(
        self, topics: set[str] | None
    ) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """The messages on the topics (None: all) in order of time."""
        try:
            with self.path.open("rb") as file:
                yield from make_reader(file, validate_crcs=True).iter_messages(topics)
        except (*MCAP_ERRORS, KeyError, RuntimeError, OSError) as error:  # RuntimeError: of lz4
            if isinstance(error, OSError) and error.errno != errno.EINVAL:  # of a damaged offset
                raise
            raise DataError(
                f"{self.path}: {error!r}; expected a complete MCAP file (`mcap recover`, of "
                "Foxglove's command line, keeps what is readable)"
            ) from error

    def _split(self, source: str) -> tuple[str, str]:
        """(Topic, steps) of ``/topic.field[0]``; a topic may contain dots."""
        for end in (len(source), *(m.start() for m in reversed([*_STEP.finditer(source)]))):
            if source[:end] in self._times:
                return source[:end], source[end:]
        topics = ", ".join(sorted(self._times)) or "none"
        raise DataError(f"{self.path}: no topic of {source!r}; the file has {topics}")


def _part(value: Any, steps: str) -> Any:
    """The part of a message at ``.field[0]``."""
    if "".join(match[0] for match in _STEP.finditer(steps)) != steps:
        raise ValueError("expected fields and indices, .field[0]")
    for name, index in _STEP.findall(steps):
        if index:
            value = value[int(index)]
            continue
        fields = _fields(value)
        if name not in fields:
            raise LookupError(f"no field {name}; there are {', '.join(fields) or 'none'}")
        value = fields[name]
    return value


def _fields(value: Any) -> Mapping[str, Any]:
    """Name -> value of a JSON object or a ROS 2 message; empty for other values."""
    if isinstance(value, Mapping):
        return value
    return {name: getattr(value, name) for name in getattr(value, "__slots__", ())}


def _values(value: Any) -> Array:
    """An image as (H, W, 3) uint8 or (H, W, 1) uint16 depth in mm; else all numbers, (n,)."""
    fields = _fields(value)
    if "data" in fields and ("format" in fields or "encoding" in fields):
        return _image(fields)
    numbers = np.array([*_numbers(value)])
    if not len(numbers):
        raise ValueError("no number in it; map another field")
    return numbers if numbers.dtype == np.bool_ else numbers.astype(np.float32)


def _numbers(value: Any) -> Iterator[Any]:
    if isinstance(value, bool | int | float | np.number):
        yield value
    elif isinstance(value, str) or value is None:
        raise ValueError(f"{value!r} is not a number; map a field that is one")
    else:
        for part in _fields(value).values() or value:
            yield from _numbers(part)


def _image(fields: Mapping[str, Any]) -> Array:
    """The image of a message with the fields of ROS 2 or Foxglove; JSON has its data in base64."""
    data = fields["data"]
    data = base64.b64decode(data) if isinstance(data, str) else bytes(data)
    if "format" in fields:
        with open_image(data, "its data") as image:
            if image.mode.startswith("I"):
                return np.asarray(image).astype(np.uint16)[..., None]
            return np.asarray(image.convert("RGB"))
    encoding, rows, columns = fields["encoding"], fields["height"], fields["width"]
    if encoding not in _PIXELS:
        raise ValueError(f"encoding {encoding!r}; expected one of {', '.join(_PIXELS)}")
    name, channels, order = _PIXELS[encoding]
    kind = np.dtype(name).newbyteorder(">" if fields.get("is_bigendian") else "<")
    used = columns * channels * kind.itemsize
    lines = np.frombuffer(data, np.uint8).reshape(rows, fields.get("step") or used)
    pixels = lines[:, :used].copy().view(kind).reshape(rows, columns, channels)[..., order]
    if kind.kind == "f":  # metres
        pixels = np.nan_to_num(pixels * 1e3, posinf=0.0).round().clip(0, 65535)
    return pixels.astype(np.uint8 if kind.itemsize == 1 else np.uint16)
