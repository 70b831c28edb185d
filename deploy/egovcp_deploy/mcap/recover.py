"""`egovcp-mcap recover`: every whole tick of a torn recording, in a new file with an index."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from egovcp.errors import UsageError
from egovcp.log.mcap import McapFile
from egovcp.log.mcap_reader import RecordingReader
from egovcp.terminal import echo


@dataclass(frozen=True)
class RecoverConfig:
    """Copy everything of a torn recording up to where it was torn into a new file, which has an
    index and opens everywhere. The torn file is left as it is, and nothing is overwritten."""

    file: str = ""
    """The torn recording."""
    output: str = ""
    """The new recording."""


CONFIG = RecoverConfig


def run(config: RecoverConfig) -> None:
    """Copy, and say how much.

    Raises:
        DataError: not a recording of ours.
        EnvironmentFailure: the output exists, or the disk is full.
    """
    if not config.file or not config.output:
        raise UsageError("from where, and where to? egovcp-mcap recover TORN OUT")
    ticks, complete = recover(Path(config.file), Path(config.output))
    was = "was complete already" if complete else "was torn"
    echo(f"{config.output}: {ticks} ticks; {config.file} {was}")


def recover(torn: Path, output: Path) -> tuple[int, bool]:
    """Copy the whole ticks of ``torn``; their number, and whether it was complete."""
    reader = RecordingReader(torn)
    copy = McapFile(output)
    copy.open(reader.metadata)
    ticks = 0
    try:
        for moment in reader.moments():
            for topic, message in moment.messages.items():
                copy.add(reader.lines[topic], moment.index, moment.time_ns, message.data)
            copy.flush()
            ticks += 1
    finally:
        copy.close()
    return ticks, reader.complete
