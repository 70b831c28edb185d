"""`egovcp-mcap recover`: copy the readable ticks of a truncated or damaged recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from egovcp.errors import UsageError
from egovcp.files import removed_on_error, user_path
from egovcp.log.mcap import McapFile
from egovcp.log.mcap_reader import RecordingReader
from egovcp.outputs import output_file
from egovcp.terminal import echo


@dataclass(frozen=True)
class RecoverConfig:
    """Copy all readable ticks of a truncated or damaged recording into a new file with an index,
    and report which ticks are lost. No existing file is changed."""

    file: str = ""
    """The truncated or damaged recording."""
    output: str = output_file()
    """The new recording."""


def run(config: RecoverConfig) -> None:
    """Copy the ticks and print how many were copied and lost. Raises `DataError` if it is not a
    recording of ours, `EnvironmentFailure` if the output exists or the disk is full."""
    if not config.file or not config.output:
        raise UsageError("two files are needed; usage: egovcp-mcap recover TRUNCATED OUT")
    source, output = (user_path(file) for file in (config.file, config.output))
    ticks, reader = recover(source, output)
    state = "is truncated: its end is missing" if reader.torn else "was already complete"
    if reader.damaged:
        torn = ", and its end is missing" if reader.torn else ""
        state = f"is damaged: {reader.loss_text()}{torn}"
    echo(f"{config.output}: {ticks} ticks; {config.file} {state}")


def recover(source: Path, output: Path) -> tuple[int, RecordingReader]:
    """Copy the readable ticks of ``source``; returns their number, and the reader, which describes
    the losses."""
    reader = RecordingReader(source)
    copy = McapFile(output)
    copy.create(reader.metadata)
    ticks = 0
    with removed_on_error(output):
        for raw in reader.raw_ticks():
            for topic, message in raw.messages.items():
                copy.add(reader.topics[topic], raw.index, raw.time_ns, message.data)
            copy.flush()
            ticks += 1
        copy.close()
    return ticks, reader
