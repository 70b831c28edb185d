"""One MCAP file per run, in ROS 2 messages that Rerun and Foxglove show without plugins.

The metadata record ``egovcp`` comes first. Every tick gives at most one message per topic,
all with the tick's time as log time, so a recording converts to dataset rows exactly; the
file is flushed after every tick, so a killed process loses none that were written, and told to
reach the disk every second, so losing power loses little more. `messages.Topic` lists the topics.
"""

from __future__ import annotations

import errno
from pathlib import Path
from typing import IO, Final, cast

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from egovcp.errors import EnvironmentFailure
from egovcp.log.append import SYNC_PERIOD_S, AppendFile
from egovcp.log.info import RunInfo
from egovcp.log.messages import Topic, encode_tick, message_type
from egovcp.log.ros2 import definition
from egovcp.log.tick import Tick

METADATA_NAME: Final = "egovcp"


class McapSink:
    """Writes ticks to ``path``; raises `EnvironmentFailure` where that cannot be created.

    After an OSError (a full disk) the file ends with the last tick that fitted, without an
    index, as after a kill; what is written later is refused.

    Args:
        path: the file to create.
        sync_period_s: seconds between two commands to the disk to keep what it has been given.
    """

    def __init__(self, path: Path, sync_period_s: float = SYNC_PERIOD_S) -> None:
        self._path = path
        self._sync_period_s = sync_period_s
        self._file: AppendFile | None = None
        self._channels: dict[Topic, int] = {}
        self._schemas: dict[str, int] = {}
        self._torn = False

    def open(self, info: RunInfo) -> None:
        """Create the file and write the metadata record."""
        try:
            self._file = AppendFile(self._path, self._sync_period_s)
        except FileExistsError as error:
            raise EnvironmentFailure(
                f"{self._path} exists already; recordings are never overwritten: choose another"
            ) from error
        self._view = info.camera
        self._writer = Writer(cast(IO[bytes], self._file), compression=CompressionType.ZSTD)
        self._writer.start(profile=Profile.ROS2, library="egovcp")
        self._writer.add_metadata(METADATA_NAME, info.to_metadata())
        self._flush()

    def write(self, tick: Tick) -> None:
        """Write the tick's messages and flush them to the operating system.

        Raises:
            OSError: the disk is full or broken.
        """
        if self._torn:
            raise OSError(errno.EIO, "given up after an earlier failure", str(self._path))
        for topic, message in encode_tick(tick, self._view).items():
            self._writer.add_message(
                channel_id=self._channel(topic),
                log_time=tick.time_ns,
                publish_time=tick.time_ns,
                sequence=tick.index,
                data=message,
            )
        self._flush()

    def close(self) -> None:
        """Write the index and close the file."""
        file, self._file = self._file, None
        if file is not None:
            if not self._torn:  # else the index would list what is not there
                self._writer.finish()  # type: ignore[no-untyped-call]
            file.close()

    def _flush(self) -> None:
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
        except OSError:
            self._torn = True
            raise

    def _channel(self, topic: Topic) -> int:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic=topic.value,
                message_encoding=MessageEncoding.CDR,
                schema_id=self._schema(message_type(topic)),
            )
        return self._channels[topic]

    def _schema(self, name: str) -> int:
        if name not in self._schemas:
            package, _, message = name.partition("/")
            self._schemas[name] = self._writer.register_schema(
                name=f"{package}/msg/{message}",
                encoding=SchemaEncoding.ROS2,
                data=definition(name).encode(),
            )
        return self._schemas[name]
