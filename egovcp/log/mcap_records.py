"""Reads the chunks of an MCAP file, torn and damaged ones included.

A complete file is read by the index at its end, so a damaged chunk does not affect the others. A
torn file has no index; it is read in order, up to the first record that does not parse.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import IO, Final

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary

MAGIC: Final = b"\x89MCAP0\r\n"
_DATA_END: Final = struct.Struct("<BQI")  # opcode, length, CRC of all bytes before it
_FOOTER: Final = struct.Struct("<BQQQI8s")  # opcode, length, two offsets, CRC, magic
_FOOTER_START: Final = struct.pack("<BQ", Opcode.FOOTER, 20)
_BLOCK_BYTES: Final = 1 << 20
#: Longer records and chunks count as damaged, so that a damaged length allocates no more.
_MAX_BYTES: Final = 256 << 20
#: Raised when damaged records are read.
MCAP_ERRORS: Final = (
    McapError,
    struct.error,
    ValueError,
    OverflowError,
    MemoryError,
    zstandard.ZstdError,
)


class RecordFile:
    """The chunks and metadata of an MCAP file that begins or ends with its magic bytes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.torn = False
        """Whether the end of the file is missing, as after a kill."""
        self.damaged = False
        """Whether `chunks` found damage other than a missing end."""
        self._summary_start = 0
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _FOOTER.size))
            tail = file.read()
            self._has_end = tail.endswith(MAGIC) or tail.startswith(_FOOTER_START)
            self.summary = self._read_summary(file)
            """The section at the end of a complete file; None if it is missing or damaged."""

    def chunks(self) -> Iterator[list[McapRecord] | None]:
        """The schemas, channels and messages of each chunk; None for a damaged chunk."""
        self.torn, self.damaged = not self._has_end, False
        with self.path.open("rb") as file:
            for chunk in self._indexed(file) if self.summary else self._in_order(file):
                records = None if chunk is None else _unpack(chunk)
                self.damaged |= records is None
                yield records
            self.damaged |= not self.torn and not self._checksums_match(file)

    def metadata(self) -> Iterator[Metadata]:
        """The metadata records before the first chunk, then those that the index lists."""
        offsets = [entry.offset for entry in self.summary.metadata_indexes] if self.summary else []
        with self.path.open("rb") as file:
            for offset in (len(MAGIC), *offsets):
                try:
                    for record in _records(file, offset):
                        if isinstance(record, Chunk | Channel | Schema | DataEnd):
                            break
                        if isinstance(record, Metadata):
                            yield record
                except MCAP_ERRORS:
                    continue

    def _indexed(self, file: IO[bytes]) -> Iterator[Chunk | None]:
        assert self.summary is not None
        for entry in sorted(self.summary.chunk_indexes, key=lambda e: e.chunk_start_offset):
            file.seek(entry.chunk_start_offset)
            content = file.read(min(entry.chunk_length, _MAX_BYTES))
            try:
                record = next(_records(BytesIO(content), 0))
            except MCAP_ERRORS:
                record = None
            yield record if isinstance(record, Chunk) else None

    def _in_order(self, file: IO[bytes]) -> Iterator[Chunk]:
        try:
            for record in _records(file, len(MAGIC)):
                if isinstance(record, Chunk):
                    yield record
                elif isinstance(record, DataEnd):
                    return
        except MCAP_ERRORS:
            self.torn = True

    def _read_summary(self, file: IO[bytes]) -> Summary | None:
        size = file.seek(0, SEEK_END)
        if size < _FOOTER.size:
            return None
        file.seek(size - _FOOTER.size)
        opcode, length, start, _, checksum, magic = _FOOTER.unpack(file.read(_FOOTER.size))
        summary_bytes = size - len(MAGIC) - 4 - start
        if (opcode, length, magic) != (Opcode.FOOTER, 20, MAGIC):
            return None
        if start == 0 or not 0 < summary_bytes <= _MAX_BYTES:
            return None
        file.seek(start)
        if checksum not in (0, zlib.crc32(file.read(summary_bytes))):
            return None
        self._summary_start = start
        file.seek(0)
        try:
            return make_reader(file).get_summary()
        except MCAP_ERRORS:
            return None

    def _checksums_match(self, file: IO[bytes]) -> bool:
        """Whether the summary and all bytes before it are undamaged."""
        if self.summary is None:
            return False
        file.seek(0)
        left, checksum = self._summary_start - _DATA_END.size, 0
        while block := file.read(min(left, _BLOCK_BYTES)):
            checksum = zlib.crc32(block, checksum)
            left -= len(block)
        end = file.read(_DATA_END.size)
        return end in (_DATA_END.pack(Opcode.DATA_END, 4, crc) for crc in (0, checksum))


def _records(file: IO[bytes], offset: int) -> Iterator[McapRecord]:
    file.seek(offset)
    reader = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=_MAX_BYTES)
    return reader.records


def _unpack(chunk: Chunk) -> list[McapRecord] | None:
    """The records of a chunk; None if it is damaged."""
    try:
        size = chunk.uncompressed_size
        if chunk.compression == "zstd":
            size = max(size, zstandard.frame_content_size(chunk.data))
        return None if size > _MAX_BYTES else breakup_chunk(chunk, validate_crc=True)
    except MCAP_ERRORS:
        return None
