"""Reads untrusted safetensors files: the header is checked before tensors are allocated.

The header holds dtype, shape and byte range of every tensor.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from egovcp.decode import DecodeError, decode, require_type, shown
from egovcp.files import UnsafeFileError, parse_json, read_bytes

HEADER_LIMIT_BYTES: Final = 1 << 20
_LENGTH_BYTES: Final = 8  # of the header, a little-endian integer before it
_METADATA: Final = "__metadata__"
_HEADER_DEPTH: Final = 4
_MAX_DIMENSIONS: Final = 8
ITEM_BYTES: Final[Mapping[str, int]] = {
    "BOOL": 1,
    "U8": 1,
    "I8": 1,
    "F8_E4M3": 1,
    "F8_E5M2": 1,
    "I16": 2,
    "U16": 2,
    "F16": 2,
    "BF16": 2,
    "I32": 4,
    "U32": 4,
    "F32": 4,
    "F64": 8,
    "I64": 8,
    "U64": 8,
}
"""Bytes of a number, by the name of its dtype in the header."""


@dataclass(frozen=True)
class TensorInfo:
    """Dtype and shape of a tensor."""

    dtype: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class TensorFile:
    """A safetensors file in memory with a valid header."""

    metadata: Mapping[str, str]
    tensors: Mapping[str, TensorInfo]
    content: bytes
    """The whole file; `safetensors.numpy.load` and `safetensors.torch.load` take it."""

    @classmethod
    def parse(cls, content: bytes) -> TensorFile:
        """Parse a file in memory.

        Raises:
            UnsafeFileError: the header is invalid, or does not match the size of the file.
        """
        length = int.from_bytes(content[:_LENGTH_BYTES], "little")
        start = _LENGTH_BYTES + length
        if len(content) < _LENGTH_BYTES or start > len(content):
            raise UnsafeFileError("not a safetensors file, or truncated")
        if length > HEADER_LIMIT_BYTES:
            raise UnsafeFileError(
                f"its header has {length} bytes, expected at most {HEADER_LIMIT_BYTES}"
            )
        try:
            text = content[_LENGTH_BYTES:start].decode("utf-8")
        except UnicodeDecodeError as error:
            raise UnsafeFileError("its header is not UTF-8") from error
        header = parse_json(text, limit_depth=_HEADER_DEPTH)
        try:
            require_type(header, dict[str, Any], "the header")
            metadata = header.pop(_METADATA, {})
            require_type(metadata, dict[str, str], _METADATA)
            entries = {
                name: decode(_Entry, value, f"tensor {shown(name)}")
                for name, value in header.items()
            }
        except DecodeError as error:
            raise UnsafeFileError(str(error)) from error
        _check_ranges(entries, len(content) - start)
        tensors = {name: TensorInfo(entry.dtype, entry.shape) for name, entry in entries.items()}
        return cls(metadata, tensors, content)

    def json_metadata(self, key: str) -> Any:
        """The JSON value in the metadata under ``key``.

        Raises:
            UnsafeFileError: it is missing, or not valid JSON.
        """
        if key not in self.metadata:
            raise UnsafeFileError(f"its metadata lack {key}")
        return parse_json(self.metadata[key])

    def require(
        self, shapes: Mapping[str, tuple[int, ...]], dtypes: Collection[str] = ("F32",)
    ) -> None:
        """Raise `UnsafeFileError` unless the file holds exactly these tensors.

        Args:
            shapes: name -> shape.
            dtypes: allowed dtypes.
        """
        self.require_names(shapes, dtypes)
        for name, info in self.tensors.items():
            if info.shape != shapes[name]:
                raise UnsafeFileError(
                    f"tensor {name} has shape {list(info.shape)}, expected {list(shapes[name])}"
                )

    def require_names(self, names: Collection[str], dtypes: Collection[str] = ("F32",)) -> None:
        """As `require`, for any shape."""
        missing = [name for name in names if name not in self.tensors]
        unknown = [name for name in self.tensors if name not in names]
        if missing:
            raise UnsafeFileError(f"{_tensors(missing)} missing: {missing[0]}")
        if unknown:
            raise UnsafeFileError(f"{_tensors(unknown)} unexpected: {shown(unknown[0])}")
        for name, info in self.tensors.items():
            if info.dtype not in dtypes:
                raise UnsafeFileError(
                    f"tensor {name} has dtype {info.dtype}, expected {' or '.join(dtypes)}"
                )


def _tensors(names: Collection[str]) -> str:
    return "a tensor is" if len(names) == 1 else f"{len(names)} tensors are"


@dataclass(frozen=True)
class _Entry:
    dtype: str
    shape: tuple[int, ...]
    data_offsets: tuple[int, int]


def _check_ranges(entries: Mapping[str, _Entry], size: int) -> None:
    """Raise unless the tensors cover the ``size`` bytes after the header exactly once."""
    end = 0
    for name, entry in sorted(entries.items(), key=lambda item: item[1].data_offsets):
        if entry.dtype not in ITEM_BYTES:
            raise UnsafeFileError(f"tensor {shown(name)} has the dtype {shown(entry.dtype)}")
        if len(entry.shape) > _MAX_DIMENSIONS or any(not 0 <= n <= size for n in entry.shape):
            raise UnsafeFileError(f"tensor {shown(name)} has an impossible shape")
        expected = end, end + math.prod(entry.shape) * ITEM_BYTES[entry.dtype]
        if entry.data_offsets != expected:
            raise UnsafeFileError(
                f"tensor {shown(name)} lies at bytes {list(entry.data_offsets)}, "
                f"expected {list(expected)}"
            )
        end = expected[1]
    if end != size:
        raise UnsafeFileError(f"its tensors have {end} bytes, {size} follow the header")


def read_tensor_file(path: Path, limit_bytes: int) -> TensorFile:
    """Read a safetensors file of at most ``limit_bytes``.

    Raises:
        UnsafeFileError: it is not a regular file, too large, or has an invalid header.
        OSError: it is missing, or cannot be read.
    """
    return TensorFile.parse(read_bytes(path, limit_bytes))
