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
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Final, cast

from mcap.records import Schema
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from egovcp.errors import EnvironmentFailure
from egovcp.log.messages import Topic, encode_tick, message_type
from egovcp.log.ros2 import definition
from egovcp.log.tick import RunInfo, Tick

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


class AppendFile:
    """A file that buffers writes and appends them at `flush`, completely or not at all.

    `flush` calls fsync at most every ``sync_period_s``, since that may take long. If the disk is
    full, the file is truncated to its last complete flush, the data stays in memory, and the next
    `flush` tries again.

    Args:
        path: the file to create; raises `FileExistsError` if it exists.
        sync_period_s: seconds between two calls of fsync; infinity: only on `close`.
    """

    def __init__(self, path: Path, sync_period_s: float = SYNC_PERIOD_S) -> None:
        self._file = path.open("xb", buffering=0)
        self._pending = bytearray()
        self._size = 0
        self._period = sync_period_s
        self._synced = time.monotonic()
        _sync_folder(path.absolute().parent)

    def write(self, data: bytes) -> int:
        """Buffer ``data``."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Size of the file and of the buffer."""
        return self._size + len(self._pending)

    def flush(self) -> None:
        """Append the buffer; on OSError the file is unchanged."""
        try:
            _write_all(self._file.fileno(), self._pending)
        except OSError:
            os.ftruncate(self._file.fileno(), self._size)
            os.lseek(self._file.fileno(), self._size, os.SEEK_SET)
            raise
        self._size += len(self._pending)
        self._pending = bytearray()
        if time.monotonic() - self._synced >= self._period:
            self._sync()

    def close(self) -> None:
        try:
            self.flush()
            self._sync()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without the buffer."""
        self._file.close()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        self._synced = time.monotonic()


def _write_all(descriptor: int, data: bytearray) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def _sync_folder(folder: Path) -> None:
    """Make the name of a new file durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@dataclass(frozen=True)
class RecordedTopic:
    """Topic, schema and message encoding of messages in a file."""

    topic: str
    schema: Schema
    encoding: str


class McapFile:
    """A new recording, written message by message.

    After an OSError (a full disk) the file ends with the last successful flush and has no index, as
    after a kill. Data that did not fit stays in memory; a later successful `flush` writes it.
    """

    def __init__(self, path: Path, sync_period_s: float = SYNC_PERIOD_S) -> None:
        self._path = path
        self._sync_period_s = sync_period_s
        self._file: AppendFile | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def open(self, metadata: Mapping[str, str]) -> None:
        """Create the file and write the metadata record.

        Raises:
            EnvironmentFailure: the file exists, or its folder does not.
        """
        try:
            self._file = AppendFile(self._path, self._sync_period_s)
        except FileExistsError as error:
            raise EnvironmentFailure(
                f"{self._path} exists already; recordings are never overwritten: choose another"
            ) from error
        except FileNotFoundError as error:
            raise EnvironmentFailure(f"{self._path} is in a folder that does not exist") from (
                error
            )
        try:
            self._begin(self._file, with_checksum(metadata))
        except BaseException:
            self.discard()
            raise

    def _begin(self, file: AppendFile, metadata: dict[str, str]) -> None:
        self._writer = Writer(
            cast(IO[bytes], file),
            chunk_size=_CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._writer.start(profile=Profile.ROS2, library="egovcp")
        self._metadata = metadata
        self._writer.add_metadata(METADATA_NAME, metadata)
        self.flush()

    def add(self, topic: RecordedTopic, index: int, time_ns: int, data: bytes) -> None:
        self._writer.add_message(
            channel_id=self._channel(topic),
            log_time=time_ns,
            publish_time=time_ns,
            sequence=index,
            data=data,
        )

    def flush(self) -> None:
        """Write everything to the file; raises OSError if the disk is full."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index and close the file; further calls do nothing.

        Raises:
            OSError: the disk is full; the file is as after a kill.
        """
        file, self._file = self._file, None
        if file is None:
            return
        with closing(file):
            self.flush()  # first: an almost full disk may take the ticks but not the index
            self._writer.add_metadata(METADATA_NAME, self._metadata)  # a second copy
            self._writer.finish()  # type: ignore[no-untyped-call]

    def discard(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.abandon()
        self._path.unlink(missing_ok=True)

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


class McapSink:
    """Writes ticks to a new `McapFile`.

    Args:
        path: the file to create.
        sync_period_s: seconds between two calls of fsync.
    """

    def __init__(self, path: Path, sync_period_s: float = SYNC_PERIOD_S) -> None:
        self._file = McapFile(path, sync_period_s)

    def open(self, info: RunInfo) -> None:
        """Create the file and write the metadata record."""
        self._file.open(info.to_metadata())
        self._view = info.camera

    def write(self, tick: Tick) -> None:
        """Write the messages of the tick and flush the file.

        Raises:
            OSError: the disk is full or broken.
        """
        for topic, message in encode_tick(tick, self._view).items():
            self._file.add(_recorded_topic(topic), tick.index, tick.time_ns, message)
        self._file.flush()

    def retry(self) -> None:
        """Write the tick that did not fit; raises OSError if the disk is still full."""
        self._file.flush()

    def close(self) -> None:
        self._file.close()

    def discard(self) -> None:
        self._file.discard()


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
