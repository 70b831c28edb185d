"""One MCAP file per run, in ROS 2 messages that Rerun and Foxglove show without plugins.

The metadata record ``egovcp`` comes first. Every tick gives at most one message per topic,
all with the tick's time as log time, so a recording converts to dataset rows exactly; the
file is flushed after every tick, so a killed process loses none that were written, and told to
reach the disk every second, so losing power loses little more. `messages.Topic` lists the topics.
"""

from __future__ import annotations

import json
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
from egovcp.log.append import SYNC_PERIOD_S, AppendFile
from egovcp.log.info import RunInfo
from egovcp.log.messages import Topic, encode_tick, message_type
from egovcp.log.ros2 import definition
from egovcp.log.tick import Tick

METADATA_NAME: Final = "egovcp"
_CHECKSUM: Final = "checksum"
#: A tick is one chunk, so that damage to a chunk leaves no half of a tick: larger than any tick.
_CHUNK_BYTES: Final = 64 << 20


def with_checksum(metadata: Mapping[str, str]) -> dict[str, str]:
    """The metadata and a CRC-32 of it: MCAP itself has none for metadata records."""
    return {**metadata, _CHECKSUM: _checksum(metadata)}


def without_checksum(metadata: Mapping[str, str]) -> dict[str, str]:
    """The inverse of `with_checksum`."""
    return {name: text for name, text in metadata.items() if name != _CHECKSUM}


def checksum_matches(metadata: Mapping[str, str]) -> bool:
    """Whether the metadata is undamaged; true for a recording of an earlier version, without
    checksum."""
    found = metadata.get(_CHECKSUM)
    return found is None or found == _checksum(without_checksum(metadata))


def _checksum(metadata: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(dict(metadata), sort_keys=True).encode()):08x}"


@dataclass(frozen=True)
class Line:
    """A topic of a file."""

    topic: str
    schema: Schema
    encoding: str
    """Of its messages."""


class McapFile:
    """A new recording, message by message; raises `EnvironmentFailure` where it cannot be created.

    After an OSError (a full disk) the file ends with the last flush that fitted, without an
    index, as after a kill. What did not fit is kept: once `flush` has succeeded, all is well.
    """

    def __init__(self, path: Path, sync_period_s: float = SYNC_PERIOD_S) -> None:
        self._path = path
        self._sync_period_s = sync_period_s
        self._file: AppendFile | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def open(self, metadata: Mapping[str, str]) -> None:
        """Create the file and write the metadata record."""
        try:
            self._file = AppendFile(self._path, self._sync_period_s)
        except FileExistsError as error:
            raise EnvironmentFailure(
                f"{self._path} exists already; recordings are never overwritten: choose another"
            ) from error
        except FileNotFoundError as error:
            raise EnvironmentFailure(f"{self._path} would lie in a folder that is not there") from (
                error
            )
        self._writer = Writer(
            cast(IO[bytes], self._file),
            chunk_size=_CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._writer.start(profile=Profile.ROS2, library="egovcp")
        self._metadata = with_checksum(metadata)
        self._writer.add_metadata(METADATA_NAME, self._metadata)
        self.flush()

    def add(self, line: Line, index: int, time_ns: int, data: bytes) -> None:
        """A message of tick ``index``."""
        self._writer.add_message(
            channel_id=self._channel(line),
            log_time=time_ns,
            publish_time=time_ns,
            sequence=index,
            data=data,
        )

    def flush(self) -> None:
        """Hand everything to the operating system; raises OSError when the disk is full."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index and close the file; raises OSError when the disk is full, and the file
        is as after a kill. Further calls do nothing."""
        file, self._file = self._file, None
        if file is None:
            return
        with closing(file):
            self.flush()  # first, so that a disk with little room gets at least this
            self._writer.add_metadata(METADATA_NAME, self._metadata)  # a copy, against damage
            self._writer.finish()  # type: ignore[no-untyped-call]

    def discard(self) -> None:
        """Close and remove the file."""
        file, self._file = self._file, None
        if file is not None:
            file.abandon()
        self._path.unlink(missing_ok=True)

    def _channel(self, line: Line) -> int:
        if line.topic not in self._channels:
            self._channels[line.topic] = self._writer.register_channel(
                topic=line.topic,
                message_encoding=line.encoding,
                schema_id=self._schema(line.schema),
            )
        return self._channels[line.topic]

    def _schema(self, schema: Schema) -> int:
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(
                name=schema.name, encoding=schema.encoding, data=schema.data
            )
        return self._schemas[schema.name]


class McapSink:
    """Writes ticks to ``path``, as an `McapFile`.

    Args:
        path: the file to create.
        sync_period_s: seconds between two commands to the disk to keep what it has been given.
    """

    def __init__(self, path: Path, sync_period_s: float = SYNC_PERIOD_S) -> None:
        self._file = McapFile(path, sync_period_s)

    def open(self, info: RunInfo) -> None:
        """Create the file and write the metadata record."""
        self._file.open(info.to_metadata())
        self._view = info.camera

    def write(self, tick: Tick) -> None:
        """Write the tick's messages and hand them to the operating system.

        Raises:
            OSError: the disk is full or broken.
        """
        for topic, message in encode_tick(tick, self._view).items():
            self._file.add(_line(topic), tick.index, tick.time_ns, message)
        self._file.flush()

    def retry(self) -> None:
        """Write the tick that did not fit; raises OSError if it still does not."""
        self._file.flush()

    def close(self) -> None:
        """Write the index and close the file."""
        self._file.close()

    def discard(self) -> None:
        """Close and remove the file."""
        self._file.discard()


@cache
def _line(topic: Topic) -> Line:
    name = message_type(topic)
    package, _, message = name.partition("/")
    schema = Schema(
        id=0,
        name=f"{package}/msg/{message}",
        encoding=SchemaEncoding.ROS2,
        data=definition(name).encode(),
    )
    return Line(topic.value, schema, MessageEncoding.CDR)
