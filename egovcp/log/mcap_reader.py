"""Reads recordings of `McapSink`, including torn and damaged files.

reader = RecordingReader(path)
for raw in reader.raw_ticks():
    raw.tick()
reader.complete  # False: the file is torn or damaged
reader.losses  # ticks that could not be read
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from mcap.records import Channel, McapRecord, Message, Metadata, Schema
from mcap_ros2.decoder import DecoderFactory

from egovcp.errors import DataError
from egovcp.files import UnsafeFileError, open_regular
from egovcp.log.mcap import METADATA_NAME, RecordedTopic, checksum_matches, without_checksum
from egovcp.log.mcap_records import MAGIC, Damage, RecordFile
from egovcp.log.messages import Topic, decode_mode, decode_tick, motor_readings
from egovcp.log.tick import MotorReadings, RunInfo, Tick
from egovcp.rate import NS_PER_S

#: Topics of a dataset row.
ROW_TOPICS: Final = frozenset(
    {Topic.DEPTH, Topic.STATE, Topic.ACTION, Topic.REWARD, Topic.MODE, Topic.LOG}
)
#: Topics of every tick.
REQUIRED_TOPICS: Final = frozenset({Topic.DEPTH, Topic.STATE, Topic.ACTION, Topic.REWARD})
_MOTOR_TOPICS: Final = frozenset({Topic.JOINTS, Topic.MOTOR_TEMPERATURE, Topic.MOTOR_STATUS})


@dataclass(frozen=True)
class Recording:
    """A recording in memory."""

    info: RunInfo
    ticks: list[Tick]
    complete: bool
    """False if the end is missing (killed process, full disk) or a part is damaged."""


def read_recording(path: Path, damaged_ok: bool = True) -> Recording:
    """Read all readable ticks of ``path`` into memory.

    Raises:
        DataError: not an MCAP file of egovcp, or damaged without ``damaged_ok``.
    """
    reader = RecordingReader(path)
    ticks = [raw.tick() for raw in reader.raw_ticks()]
    if not damaged_ok:
        reader.require_undamaged()
    return Recording(reader.info, ticks, reader.complete)


@dataclass
class RawTick:
    """The messages of one tick, not decoded."""

    index: int
    time_ns: int
    topics: Mapping[str, RecordedTopic]
    decoders: DecoderFactory
    """Decoders of this file; it caches them by schema id."""
    messages: dict[str, Message] = field(default_factory=dict)

    def tick(self, topics: Collection[str] | None = None) -> Tick:
        """Decode the tick, or only the messages on ``topics``.

        Raises:
            DataError: it lacks a required topic, or a message is damaged.
        """
        wanted = self.messages.keys() if topics is None else self.messages.keys() & set(topics)
        try:
            return decode_tick(
                self.index, self.time_ns, {name: self._decode(name) for name in wanted}
            )
        except KeyError as error:
            raise DataError(f"tick {self.index} has nothing on topic {error.args[0]}") from error
        except (struct.error, ValueError, IndexError, AttributeError) as error:
            raise DataError(f"tick {self.index} is damaged: {error}") from error

    def text(self, topic: str) -> str:
        """Text of the log message on ``topic``; empty without one."""
        return str(self._decode(topic).msg) if topic in self.messages else ""

    def mode(self) -> str:
        """`Tick.mode`.

        Raises:
            DataError: the message is damaged.
        """
        return decode_mode(self._decoded({Topic.MODE}).get(Topic.MODE))

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
        """Topic -> decoded message, for those of ``topics`` that the tick has."""
        try:
            return {name: self._decode(name) for name in self.messages.keys() & set(topics)}
        except (struct.error, ValueError, IndexError, AttributeError) as error:
            raise DataError(f"tick {self.index} is damaged: {error}") from error

    def _decode(self, topic: str) -> Any:
        known = self.topics[topic]
        decode = self.decoders.decoder_for(known.encoding, known.schema)
        if decode is None:
            raise DataError(f"topic {topic} is {known.schema.name} in {known.encoding}, not ROS 2")
        return decode(self.messages[topic].data)


@dataclass(frozen=True)
class Loss:
    """Ticks made unreadable by damage."""

    after: tuple[int, int] | None
    """Index and time, ns, of the last readable tick before it; None: there is none."""
    before: tuple[int, int] | None
    """Index and time, ns, of the first readable tick after it; None: there is none."""
    ticks: int | None
    """How many ticks were lost; None: unknown."""


class RecordingReader:
    """Iterates over a recording in constant memory; skips damaged parts (see `mcap_records`).

    Raises:
        DataError: not an MCAP file of egovcp.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        _require_mcap(path)
        self._file = RecordFile(path)
        self.complete = False
        """Whether `raw_ticks` has read the whole file without damage."""
        self.losses: list[Loss] = []
        """Losses that `raw_ticks` has found, without those at the end of a torn file."""
        self.topics: dict[str, RecordedTopic] = {}
        """The topics found so far."""
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._decoders = DecoderFactory()
        self._metadata_damaged = False
        self._start_ns = 0
        self.metadata = self._read_metadata()
        """The record ``egovcp``, without its checksum."""
        self.info = self._info()

    @property
    def torn(self) -> bool:
        """Whether the end of the file is missing, as after a kill."""
        return self._file.torn

    @property
    def damaged(self) -> bool:
        """Whether `raw_ticks` has found damage, other than a missing end."""
        return self._file.damaged or self._metadata_damaged

    def raw_ticks(self) -> Iterator[RawTick]:
        """The readable ticks in order."""
        self.losses, self.complete = [], False
        count, last, open_loss = 0, None, False
        for raw in self._grouped():
            if isinstance(raw, Damage):
                open_loss = True
                continue
            if self._file.damage and not raw.messages.keys() >= REQUIRED_TOPICS:
                open_loss = True  # some of its chunks were damaged
                continue
            if open_loss:
                self._add_loss(last, raw)
            if last is None:
                self._start_ns = raw.time_ns - raw.index * NS_PER_S // self.info.fps
            last, open_loss, count = raw, False, count + 1
            yield raw
        if open_loss:
            self._add_final_loss(last, count)
        self.complete = not self.torn and not self.damaged

    def require_undamaged(self) -> None:
        """Raise `DataError` if `raw_ticks` has found damage, other than a missing end."""
        if self.damaged:
            raise DataError(
                f"{self._path} is damaged: {self.loss_text()}; keep the readable ticks: "
                f"egovcp-mcap recover {self._path} RECOVERED.mcap"
            )

    def loss_text(self) -> str:
        """Number and place of lost ticks, or "no tick is lost"."""
        lost = [loss for loss in self.losses if loss.ticks != 0]
        if not lost:
            return "no tick is lost"
        known = [loss.ticks for loss in lost if loss.ticks is not None]
        total = f"{sum(known)} ticks are lost" if sum(known) != 1 else "1 tick is lost"
        if len(known) < len(lost):
            total = f"at least {total}" if known else "an unknown number of ticks is lost"
        return f"{total} ({', '.join(map(self._place, lost[:_SHOWN_LOSSES]))}" + (
            f" and {len(lost) - _SHOWN_LOSSES} more places)" if len(lost) > _SHOWN_LOSSES else ")"
        )

    def _place(self, loss: Loss) -> str:
        first = loss.after[0] + 1 if loss.after else 0
        if loss.before is None and loss.ticks is None:
            return f"from tick {first} on"
        end = loss.before[0] if loss.before else first + (loss.ticks or 0)
        ticks = f"tick {first}" if end - first == 1 else f"ticks {first} to {end - 1}"
        if loss.after is None or loss.before is None:
            return ticks
        start, stop = (
            (time - self._start_ns) / NS_PER_S for time in (loss.after[1], loss.before[1])
        )
        return f"{ticks} between {start:.2f} and {stop:.2f} s"

    def _add_loss(self, last: RawTick | None, raw: RawTick) -> None:
        after = (last.index, last.time_ns) if last else None
        first = last.index + 1 if last else 0
        before = (raw.index, raw.time_ns)
        self.losses.append(Loss(after, before, max(0, raw.index - first)))

    def _add_final_loss(self, last: RawTick | None, count: int) -> None:
        """Add damage at the end; the statistics give the number of lost ticks."""
        after = (last.index, last.time_ns) if last else None
        summary, ticks = self._file.summary, None
        if summary and summary.statistics:
            written = [
                summary.statistics.channel_message_counts.get(channel.id, 0)
                for channel in summary.channels.values()
                if channel.topic == Topic.STATE
            ]
            ticks = max(0, sum(written) - count - sum(loss.ticks or 0 for loss in self.losses))
        self.losses.append(Loss(after, None, ticks))

    def _grouped(self) -> Iterator[RawTick | Damage]:
        """The messages of each tick, and damage, in file order."""
        raw: RawTick | None = None
        for record in self._file.records():
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._add_channel(record)
            elif isinstance(record, Message | Damage):
                same = isinstance(record, Message) and raw and raw.index == record.sequence
                if raw is not None and not same:
                    yield raw
                    raw = None
                if isinstance(record, Damage):
                    yield record
                elif channel := self._channel(record.channel_id):
                    raw = raw or self._raw_tick(record)
                    raw.messages[channel.topic] = record
        if raw is not None:
            yield raw

    def _raw_tick(self, first: Message) -> RawTick:
        return RawTick(first.sequence, first.log_time, self.topics, self._decoders)

    def _channel(self, number: int) -> Channel | None:
        """A channel; if its own record is damaged, it is taken from the summary."""
        if number not in self._channels and self._file.summary:
            channel = self._file.summary.channels.get(number)
            if channel is not None:
                self._add_channel(channel)
        return self._channels.get(number)

    def _add_channel(self, channel: Channel) -> None:
        repeated = self._file.summary.schemas if self._file.summary else {}
        schema = self._schemas.get(channel.schema_id) or repeated.get(channel.schema_id)
        if schema is not None:
            self._channels[channel.id] = channel
            self.topics[channel.topic] = RecordedTopic(
                channel.topic, schema, channel.message_encoding
            )

    def _read_metadata(self) -> Mapping[str, str]:
        """The metadata record before the first tick, or its copy at the end."""
        found = False
        for record in self._first_records():
            if isinstance(record, Metadata) and record.name == METADATA_NAME:
                found = True
                if checksum_matches(record.metadata):
                    return without_checksum(record.metadata)
        for entry in self._file.summary.metadata if self._file.summary else ():
            copy = self._file.metadata_at(entry.offset)
            if copy and copy.name == METADATA_NAME and checksum_matches(copy.metadata):
                self._metadata_damaged = True
                return without_checksum(copy.metadata)
        if found or self._file.damage:
            raise DataError(
                f"{self._path}: its metadata record {METADATA_NAME!r} is damaged, and there is no "
                "readable copy of it at the end; the recording cannot be read"
            )
        raise DataError(
            f"{self._path} has no metadata record {METADATA_NAME!r} before its first message; "
            "expected a recording of egovcp"
        )

    def _first_records(self) -> Iterator[McapRecord | Damage]:
        for record in self._file.records():
            if isinstance(record, Message | Channel | Schema):
                return
            yield record

    def _info(self) -> RunInfo:
        try:
            return RunInfo.from_metadata(self.metadata)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            problem = f"its metadata record {METADATA_NAME!r} is damaged: {error!r}"
            raise DataError(f"{self._path}: {problem}") from error


_SHOWN_LOSSES: Final = 5


def _require_mcap(path: Path) -> None:
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
