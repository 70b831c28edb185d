"""Writes one MCAP file per run, in ROS 2 messages that Rerun and Foxglove show without plugins.

The metadata record ``egovcp`` comes first. Every tick has at most one message per topic
(`messages.Topic`), with the time of the tick as log time, so a recording converts to dataset rows
exactly. The file is flushed after every tick and synchronised every second: a killed process loses
no written tick, a power failure about one second.
"""

from __future__ import annotations

import json
import os
import time
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Final

from mcap.records import Schema
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from egovcp.errors import EnvironmentFailure
from egovcp.files import sync
from egovcp.log.messages import Topic, encode_tick, message_type
from egovcp.log.ros2 import definition
from egovcp.log.tick import RunInfo, Tick, existing_file_error

SYNC_PERIOD_S: Final = 1.0
METADATA_NAME: Final = "egovcp"
_CHECKSUM: Final = "checksum"
#: Larger than any tick: a tick is one chunk, so that a damaged chunk never leaves half a tick.
_CHUNK_BYTES: Final = 64 << 20


def with_checksum(metadata: Mapping[str, str]) -> dict[str, str]:
    """The metadata and a CRC-32 of it: MCAP itself has none for metadata records."""
    return {**metadata, _CHECKSUM: _checksum(metadata)}


def without_checksum(metadata: Mapping[str, str]) -> dict[str, str]:
    """The inverse of `with_checksum`."""
    return {name: text for name, text in metadata.items() if name != _CHECKSUM}


def checksum_matches(metadata: Mapping[str, str]) -> bool:
    """Whether the metadata is undamaged; true for older recordings without a checksum."""
    found = metadata.get(_CHECKSUM)
    return found is None or found == _checksum(without_checksum(metadata))


def _checksum(metadata: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(dict(metadata), sort_keys=True).encode()):08x}"


@dataclass(frozen=True)
class RecordedTopic:
    """Topic, schema and message encoding of messages in a file."""

    topic: str
    schema: Schema
    encoding: str


class McapFile:
    """A new recording, written message by message.

    After an OSError (a full disk) the file ends with a torn tick and has no index, as after a kill.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def create(self, metadata: Mapping[str, str]) -> None:
        """Create the file and write the metadata record."""
        try:
            self._file = self._path.open("xb")
        except FileExistsError as error:
            raise existing_file_error(self._path) from error
        except FileNotFoundError as error:
            raise EnvironmentFailure(f"{self._path} is in a folder that does not exist") from (
                error
            )
        self._metadata = with_checksum(metadata)
        self._synced = time.monotonic()
        try:
            self._writer = Writer(
                self._file,
                chunk_size=_CHUNK_BYTES,
                compression=CompressionType.ZSTD,
                enable_data_crcs=True,
            )
            self._writer.start(profile=Profile.ROS2, library="egovcp")
            self._writer.add_metadata(METADATA_NAME, self._metadata)
            self.flush()
            sync(self._path.absolute().parent)
        except BaseException:
            file, self._file = self._file, None
            self._path.unlink(missing_ok=True)
            with suppress(OSError):
                file.close()
            raise

    def add(self, topic: RecordedTopic, index: int, time_ns: int, data: bytes) -> None:
        self._writer.add_message(
            channel_id=self._channel(topic),
            log_time=time_ns,
            publish_time=time_ns,
            sequence=index,
            data=data,
        )

    def flush(self) -> None:
        """Write everything to the file, and to the disk if the last time is `SYNC_PERIOD_S` ago."""
        assert self._file is not None, "open the file before writing to it"
        self._writer.flush()  # type: ignore[no-untyped-call]
        if time.monotonic() - self._synced >= SYNC_PERIOD_S:
            os.fsync(self._file.fileno())
            self._synced = time.monotonic()

    def close(self) -> None:
        """Write the index and close the file; further calls do nothing."""
        file, self._file = self._file, None
        if file is None:
            return
        with file:
            # first: an almost full disk may take the ticks but not the index
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._writer.add_metadata(METADATA_NAME, self._metadata)  # a second copy
            self._writer.finish()  # type: ignore[no-untyped-call]
            file.flush()
            os.fsync(file.fileno())

    def _channel(self, topic: RecordedTopic) -> int:
        if topic.topic not in self._channels:
            self._channels[topic.topic] = self._writer.register_channel(
                topic=topic.topic,
                message_encoding=topic.encoding,
                schema_id=self._schema(topic.schema),
            )
        return self._channels[topic.topic]

    def _schema(self, schema: Schema) -> int:
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(
                name=schema.name, encoding=schema.encoding, data=schema.data
            )
        return self._schemas[schema.name]


class McapSink(McapFile):
    """Writes the ticks of a run to a new file."""

    def open(self, info: RunInfo) -> None:
        """Create the file and write the metadata record."""
        self.create(info.to_metadata())
        self._view, self._robot = info.camera, info.robot

    def write(self, tick: Tick) -> None:
        """Write the messages of the tick and flush the file."""
        for topic, message in encode_tick(tick, self._view, self._robot).items():
            self.add(_recorded_topic(topic), tick.index, tick.time_ns, message)
        self.flush()


@cache
def _recorded_topic(topic: Topic) -> RecordedTopic:
    name = message_type(topic)
    package, _, message = name.partition("/")
    schema = Schema(
        id=0,
        name=f"{package}/msg/{message}",
        encoding=SchemaEncoding.ROS2,
        data=definition(name).encode(),
    )
    return RecordedTopic(topic.value, schema, MessageEncoding.CDR)
