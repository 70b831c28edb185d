"""Reads recordings of `McapSink`, including torn and damaged files.

reader = RecordingReader(path)
for raw in reader.raw_ticks():
    raw.tick()
reader.complete  # False: the file is torn or damaged
reader.losses  # ticks that could not be read
"""

from __future__ import annotations

import shlex
import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.records import Channel, Message, Schema
from mcap_ros2.decoder import DecoderFactory

from egovcp.errors import DataError
from egovcp.files import UnsafeFileError, open_regular
from egovcp.log.mcap import METADATA_NAME, RecordedTopic, checksum_matches, without_checksum
from egovcp.log.mcap_records import MAGIC, RecordFile
from egovcp.log.messages import Topic, decode_tick, motor_readings
from egovcp.log.tick import MotorReadings, RunInfo, Tick
from egovcp.rate import NS_PER_S

#: Topics of a dataset row.
ROW_TOPICS: Final = frozenset(
    {Topic.DEPTH, Topic.STATE, Topic.ACTION, Topic.REWARD, Topic.MODE, Topic.LOG}
)
_MOTOR_TOPICS: Final = frozenset({Topic.JOINTS, Topic.MOTOR_TEMPERATURE, Topic.MOTOR_STATUS})
_SHOWN_LOSSES: Final = 5


@dataclass(frozen=True)
class Recording:
    """A recording in memory."""

    info: RunInfo
    ticks: list[Tick]
    complete: bool
    """False if the end is missing (killed process, full disk) or a part is damaged."""


def read_recording(
    path: Path, damaged_ok: bool = True, topics: Collection[str] | None = None
) -> Recording:
    """Read all readable ticks of ``path``, or only ``topics`` of them; raises `DataError` for
    damage without ``damaged_ok``."""
    reader = RecordingReader(path)
    ticks = [raw.tick(topics) for raw in reader.raw_ticks()]
    if not damaged_ok:
        reader.require_undamaged()
    return Recording(reader.info, ticks, reader.complete)


@dataclass
class RawTick:
    """The messages of one tick, not decoded. Its methods raise `DataError` for damaged messages."""

    index: int
    time_ns: int
    topics: Mapping[str, RecordedTopic]
    decoders: DecoderFactory
    """Decoders of this file; it caches them by schema id."""
    messages: dict[str, Message]

    def tick(self, topics: Collection[str] | None = None) -> Tick:
        """Decode the tick, or only the messages on ``topics``; a required topic must be there."""
        with self._errors():
            return decode_tick(self.index, self.time_ns, self._decode(topics or self.messages))

    def text(self, topic: str) -> str:
        """Text of the log message on ``topic``; empty without one."""
        return "".join(str(message.msg) for message in self._decode({topic}).values())

    def motors(self) -> MotorReadings | None:
        with self._errors():
            return motor_readings(self._decode(_MOTOR_TOPICS))

    def _decode(self, topics: Collection[str]) -> dict[str, Any]:
        """Topic -> decoded message, for those of ``topics`` that the tick has."""
        decoded = {}
        for name in self.messages.keys() & set(topics):
            known = self.topics[name]
            decode = self.decoders.decoder_for(known.encoding, known.schema)
            if decode is None:
                kind = f"{known.schema.name} in {known.encoding}"
                raise DataError(f"topic {name} is {kind}, not ROS 2")
            with self._errors():
                decoded[name] = decode(self.messages[name].data)
        return decoded

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except KeyError as error:
            raise DataError(f"tick {self.index} has nothing on topic {error.args[0]}") from error
        except (struct.error, ValueError, IndexError, AttributeError) as error:
            raise DataError(f"tick {self.index} is damaged: {error}") from error


class Loss(NamedTuple):
    """Consecutive ticks made unreadable by damage."""

    ticks: int
    place: str


class RecordingReader:
    """Iterates over a recording in constant memory; skips damaged parts (see `mcap_records`)."""

    def __init__(self, path: Path) -> None:
        self._path = path
        require_mcap(path)
        self._file = RecordFile(path)
        self.complete = False
        """Whether `raw_ticks` has read the whole file without damage."""
        self.losses: list[Loss] = []
        """Losses that `raw_ticks` has found, without those at the end of a torn file."""
        self.topics: dict[str, RecordedTopic] = {}
        """The topics found so far."""
        summary = self._file.summary
        self._schemas: dict[int, Schema] = dict(summary.schemas) if summary else {}
        self._topic_of: dict[int, str] = {}  # by channel id
        for channel in summary.channels.values() if summary else ():
            self._add_channel(channel)
        self._decoders = DecoderFactory()
        self.metadata = self._read_metadata()
        """The record ``egovcp``, without its checksum."""
        try:
            self.info = RunInfo.from_metadata(self.metadata)
        except (KeyError, ValueError) as error:
            problem = f"its metadata record {METADATA_NAME!r} is damaged: {error!r}"
            raise DataError(f"{self._path}: {problem}") from error

    @property
    def torn(self) -> bool:
        """Whether `raw_ticks` found that the end of the file is missing, as after a kill."""
        return self._file.torn

    @property
    def damaged(self) -> bool:
        """Whether `raw_ticks` has found damage, other than a missing end."""
        return self._file.damaged

    def raw_ticks(self) -> Iterator[RawTick]:
        """The readable ticks in order."""
        self.losses, self.complete = [], False
        last, lost, start_ns = None, 0, 0
        for index, group in groupby(self._messages(), lambda m: m.sequence if m else None):
            if index is None:
                lost += len(list(group))
                continue
            messages = [message for message in group if message]
            raw = RawTick(
                index,
                messages[0].log_time,
                self.topics,
                self._decoders,
                {self._topic_of[message.channel_id]: message for message in messages},
            )
            if last is None:
                start_ns = raw.time_ns - raw.index * NS_PER_S // self.info.fps
            if lost:
                self.losses.append(_loss(lost, last, raw, start_ns))
            last, lost = raw, 0
            yield raw
        if lost:
            self.losses.append(_loss(lost, last, None, start_ns))
        self.complete = not self.torn and not self.damaged

    def require_undamaged(self) -> None:
        """Raise `DataError` if `raw_ticks` has found damage, other than a missing end."""
        if self.damaged:
            raise DataError(
                f"{self._path} is damaged: {self.loss_text()}; keep the readable ticks: "
                f"egovcp-mcap recover {shlex.quote(str(self._path))} RECOVERED.mcap"
            )

    def loss_text(self) -> str:
        """Number and place of lost ticks, or "no tick is lost"."""
        total = sum(loss.ticks for loss in self.losses)
        if total == 0:
            return "no tick is lost"
        places = ", ".join(loss.place for loss in self.losses[:_SHOWN_LOSSES])
        if (more := len(self.losses) - _SHOWN_LOSSES) > 0:
            places += f" and {more} more places"
        return f"{total} ticks are lost ({places})" if total > 1 else f"1 tick is lost ({places})"

    def _messages(self) -> Iterator[Message | None]:
        """The messages in file order; None for each damaged chunk, which holds one tick."""
        for records in self._file.chunks():
            if records is None:
                yield None
            for record in records or ():
                if isinstance(record, Schema):
                    self._schemas[record.id] = record
                elif isinstance(record, Channel):
                    self._add_channel(record)
                elif isinstance(record, Message) and record.channel_id in self._topic_of:
                    yield record

    def _add_channel(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        if schema is not None:
            self._topic_of[channel.id] = channel.topic
            self.topics[channel.topic] = RecordedTopic(
                channel.topic, schema, channel.message_encoding
            )

    def _read_metadata(self) -> Mapping[str, str]:
        """The metadata record before the first tick, or its copy at the end."""
        for record in self._file.metadata():
            if record.name == METADATA_NAME and checksum_matches(record.metadata):
                return without_checksum(record.metadata)
        raise DataError(
            f"{self._path}: its metadata record {METADATA_NAME!r} is damaged or missing; expected "
            "a recording of egovcp (others: egovcp-mcap to-dataset --mapping=FILE)"
        )


def _loss(ticks: int, last: RawTick | None, following: RawTick | None, start_ns: int) -> Loss:
    """A loss between two readable ticks, or at an end; ``start_ns`` is the time of tick 0."""
    first = last.index + 1 if last else 0
    end = following.index if following else first + ticks
    place = f"tick {first}" if end - first == 1 else f"ticks {first} to {end - 1}"
    if last and following:
        start, stop = ((raw.time_ns - start_ns) / NS_PER_S for raw in (last, following))
        place += f" between {start:.2f} and {stop:.2f} s"
    return Loss(ticks, place)


def require_mcap(path: Path) -> None:
    """Raise `DataError` for a file that neither starts nor ends with the MCAP magic bytes."""
    try:
        with open_regular(path) as file:  # a FIFO would block
            start = file.read(len(MAGIC))
            file.seek(max(0, path.stat().st_size - len(MAGIC)))
            end = file.read(len(MAGIC))
    except FileNotFoundError as error:
        raise DataError(f"no recording at {path}; expected an MCAP file") from error
    except UnsafeFileError as error:
        raise DataError(f"{path} is {error}") from error
    if MAGIC not in (start, end):
        found = "is empty" if not start else f"begins with {start!r}"
        raise DataError(f"{path} {found}; expected an MCAP file")
