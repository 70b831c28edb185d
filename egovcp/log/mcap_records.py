"""Reads the records of an MCAP file in order and skips damaged ones.

`mcap.stream_reader.StreamReader` stops at the first damaged record. Here a record that does not
parse, or a chunk whose checksum does not match, is skipped: reading continues at the next chunk
whose checksum matches. The summary at the end of the file provides the schemas and channels whose
own records were damaged.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import get_chunk_data_stream

MAGIC: Final = b"\x89MCAP0\r\n"
_HEADER: Final = struct.Struct("<BQ")
_FOOTER_LENGTH: Final = 8 + 8 + 4
_FOOTER_BYTES: Final = _HEADER.size + _FOOTER_LENGTH + len(MAGIC)
#: Compression field of a chunk. Recordings are always compressed with zstd.
_ZSTD: Final = struct.pack("<I", 4) + b"zstd"
#: From the start of a chunk record to its compression field: header, two times, size, CRC.
_BEFORE_COMPRESSION: Final = _HEADER.size + 8 + 8 + 8 + 4
_BLOCK: Final = 1 << 20
#: Longer records and chunks count as damaged, so that a damaged length allocates no more, bytes.
_MAX_BYTES: Final = 256 << 20
_PARSE_ERRORS: Final = (
    McapError,
    struct.error,
    ValueError,
    OverflowError,
    MemoryError,
    zstandard.ZstdError,
)
_PARSERS: Final[dict[int, Any]] = {
    Opcode.HEADER: Header.read,
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.MESSAGE_INDEX: MessageIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: Metadata.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.DATA_END: DataEnd.read,
}
_SKIPPED: Final = (
    Opcode.ATTACHMENT,
    Opcode.ATTACHMENT_INDEX,
    Opcode.CHUNK_INDEX,
    Opcode.SUMMARY_OFFSET,
)


class DamagedRecord(ValueError):
    """The content of a record does not match its length, its format or its checksum."""


@dataclass(frozen=True)
class Damage:
    """A range of bytes that holds no readable record."""

    start: int
    """Offset in the file."""
    end: int
    """Offset of the first readable record after it, or of the end of the data section."""


@dataclass(frozen=True)
class SummarySection:
    """The summary section at the end of a complete file."""

    start: int
    """Offset of its first byte."""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[MetadataIndex] = field(default_factory=list)
    statistics: Statistics | None = None


class RecordFile:
    """The records of an MCAP file.

    Args:
        path: the file; it begins or ends with the magic bytes of MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = path.stat().st_size
        self.damage: list[Damage] = []
        """Damaged ranges of the data section, as far as `records` has read."""
        self.checksum_matches = True
        """False if `records` found that the checksum of the data section is wrong."""
        with path.open("rb") as file:
            self.summary = self._summary(file)
            """None if the file is torn, or its summary damaged."""
            self.torn = not self._has_end(file)
            """Whether the end of the file is missing, as after a kill."""
            file.seek(0)
            self._has_magic = file.read(len(MAGIC)) == MAGIC

    @property
    def damaged(self) -> bool:
        """Whether something before the end of the file is damaged, as far as `records` has read."""
        frame_matches = self._has_magic and (self.torn or self.summary is not None)
        return bool(self.damage) or not self.checksum_matches or not frame_matches

    def records(self) -> Iterator[McapRecord | Damage]:
        """Schemas, channels, messages and metadata in file order, including those in chunks; a
        `Damage` in place of each damaged range."""
        self.damage, self.checksum_matches = [], True
        with self.path.open("rb") as file:
            position, checksum = len(MAGIC), zlib.crc32(MAGIC)
            while True:
                try:
                    record, content = read_record(file, position, self.size)
                    found = unpack_chunk(record) if isinstance(record, Chunk) else []
                except _PARSE_ERRORS:
                    following = self._next_chunk(file, position)
                    yield from self._skipped(position, following)
                    if following is None:
                        return
                    yield from following.records
                    position = following.end
                    continue
                if isinstance(record, DataEnd):
                    expected = record.data_section_crc
                    self.checksum_matches = bool(self.damage) or expected in (0, checksum)
                    return
                checksum = zlib.crc32(content, checksum)
                position += len(content)
                if found:
                    yield from found
                elif record is not None:
                    yield record

    def metadata_at(self, offset: int) -> Metadata | None:
        """The metadata record at an offset; None if it is damaged."""
        with self.path.open("rb") as file:
            try:
                record, _ = read_record(file, offset, self.size)
            except _PARSE_ERRORS:
                return None
        return record if isinstance(record, Metadata) else None

    def _skipped(self, position: int, following: _ChunkAt | None) -> Iterator[Damage]:
        """The damage between ``position`` and the next chunk, or the end of the data section."""
        if following is not None:
            end = following.start
        elif not self.torn:
            end = self.summary.start if self.summary else self.size
        else:
            return
        damage = Damage(position, max(end, position))
        self.damage.append(damage)
        yield damage

    def _next_chunk(self, file: IO[bytes], start: int) -> _ChunkAt | None:
        """The first chunk at or after ``start`` whose checksum matches; its record header may be
        damaged and is ignored."""
        end = self.summary.start if self.summary else self.size
        position = start + _BEFORE_COMPRESSION
        while position < end:
            file.seek(position)
            block = file.read(_BLOCK + len(_ZSTD))
            at = block.find(_ZSTD)
            if at < 0:
                position += _BLOCK
                continue
            chunk = _chunk_at(file, position + at - _BEFORE_COMPRESSION, end)
            if chunk is not None:
                return chunk
            position += at + 1
        return None

    def _summary(self, file: IO[bytes]) -> SummarySection | None:
        """The summary, if its checksum matches."""
        try:
            footer, _ = read_record(file, self.size - _FOOTER_BYTES, self.size)
        except _PARSE_ERRORS:
            return None
        end = self.size - _FOOTER_BYTES
        if not isinstance(footer, Footer) or not 0 < footer.summary_start <= end:
            return None
        if end - footer.summary_start > _MAX_BYTES:
            return None
        file.seek(footer.summary_start)
        content = file.read(end + _HEADER.size + 8 + 8 - footer.summary_start)
        if footer.summary_crc not in (0, zlib.crc32(content)) or file.read(12)[4:] != MAGIC:
            return None
        summary = SummarySection(footer.summary_start)
        position = footer.summary_start
        while position < end:
            try:
                record, raw = read_record(file, position, end)
            except _PARSE_ERRORS:
                return None
            position += len(raw)
            if isinstance(record, Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, Channel):
                summary.channels[record.id] = record
            elif isinstance(record, MetadataIndex):
                summary.metadata.append(record)
            elif isinstance(record, Statistics):
                summary = SummarySection(**{**vars(summary), "statistics": record})
        return summary

    def _has_end(self, file: IO[bytes]) -> bool:
        """Whether the writer closed the file: it ends with a footer or the magic bytes."""
        if self.size < _FOOTER_BYTES:
            return False
        file.seek(self.size - _FOOTER_BYTES)
        tail = file.read(_FOOTER_BYTES)
        return tail.endswith(MAGIC) or tail.startswith(_HEADER.pack(Opcode.FOOTER, _FOOTER_LENGTH))


@dataclass(frozen=True)
class _ChunkAt:
    """A chunk found by its content, not by its header."""

    start: int
    end: int
    records: list[McapRecord]


def _chunk_at(file: IO[bytes], start: int, limit: int) -> _ChunkAt | None:
    """The chunk whose record starts at ``start``, whatever the record header says."""
    file.seek(start + _HEADER.size)
    fields = file.read(_BEFORE_COMPRESSION - _HEADER.size + len(_ZSTD) + 8)
    length = len(fields) + int.from_bytes(fields[-8:], "little")
    end = start + _HEADER.size + length
    if end > limit or length > _MAX_BYTES:
        return None
    try:
        body = fields + file.read(length - len(fields))
        chunk = _parse(Opcode.CHUNK, body)
        return _ChunkAt(start, end, unpack_chunk(chunk)) if isinstance(chunk, Chunk) else None
    except _PARSE_ERRORS:
        return None


def read_record(file: IO[bytes], position: int, limit: int) -> tuple[McapRecord | None, bytes]:
    """The record at ``position`` and its bytes; None for kinds that are not used here.

    Raises:
        DamagedRecord, McapError, ValueError, struct.error: there is no whole record.
    """
    file.seek(max(position, 0))
    header = file.read(_HEADER.size)
    opcode, length = _HEADER.unpack(header)
    if position + len(header) + length > limit or length > _MAX_BYTES:
        raise DamagedRecord(f"the record at byte {position} is {length} bytes long")
    body = file.read(length)
    return _parse(opcode, body), header + body


def _parse(opcode: int, body: bytes) -> McapRecord | None:
    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.MESSAGE:
        message: Message = Message.read(stream, len(body))
        return message
    if opcode in _SKIPPED:
        return None
    if opcode not in _PARSERS:
        raise DamagedRecord(f"no record has the opcode {opcode}")
    record: McapRecord = _PARSERS[opcode](stream)
    if stream.count != len(body):
        raise DamagedRecord(f"a {type(record).__name__} of {len(body)} bytes has {stream.count}")
    return record


def unpack_chunk(chunk: Chunk) -> list[McapRecord]:
    """The schemas, channels and messages of a chunk whose checksum matches.

    Raises:
        DamagedRecord, McapError, ValueError, struct.error, ZstdError: it does not.
    """
    content = _decompress(chunk)
    if len(content) != chunk.uncompressed_size and not chunk.uncompressed_crc:
        raise DamagedRecord("the size of a chunk does not match")
    if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise DamagedRecord("the checksum of a chunk does not match")
    stream, records, position = BytesIO(content), [], 0
    while position < len(content):
        record, raw = read_record(stream, position, len(content))
        if record is not None:
            records.append(record)
        position += len(raw)
    return records


def _decompress(chunk: Chunk) -> bytes:
    if chunk.compression != "zstd":
        stream, length = get_chunk_data_stream(chunk)
        return bytes(stream.read(length))
    size = zstandard.get_frame_parameters(chunk.data).content_size
    if size == zstandard.CONTENTSIZE_UNKNOWN:
        size = chunk.uncompressed_size
    if size > _MAX_BYTES:
        raise DamagedRecord(f"a chunk of {size} bytes")
    return zstandard.decompress(chunk.data, max_output_size=size)
