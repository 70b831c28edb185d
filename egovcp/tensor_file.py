"""Reads the headers of untrusted safetensors files, before `safetensors` loads the tensors.

The header holds dtype, shape and byte range of every tensor; `safetensors` checks the ranges.
"""

from __future__ import annotations

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


@dataclass(frozen=True)
class TensorInfo:
    """A tensor in the header."""

    dtype: str
    shape: tuple[int, ...]
    data_offsets: tuple[int, int]


@dataclass(frozen=True)
class TensorFile:
    """A safetensors file in memory."""

    metadata: Mapping[str, str]
    tensors: Mapping[str, TensorInfo]
    content: bytes
    """The whole file; `safetensors.numpy.load` and `safetensors.torch.load` take it."""

    @classmethod
    def parse(cls, content: bytes) -> TensorFile:
        """Parse a file in memory.

        Raises:
            UnsafeFileError: the header is invalid.
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
            tensors = {
                name: decode(TensorInfo, value, f"tensor {shown(name)}")
                for name, value in header.items()
            }
        except DecodeError as error:
            raise UnsafeFileError(str(error)) from error
        return cls(metadata, tensors, content)

    def json_metadata(self, key: str) -> Any:
        """The JSON value in the metadata under ``key``.

        Raises:
            UnsafeFileError: it is missing, or not valid JSON.
        """
        if key not in self.metadata:
            raise UnsafeFileError(f"its metadata has no key {key}")
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
            raise UnsafeFileError(f"tensor {missing[0]} is missing")
        if unknown:
            raise UnsafeFileError(f"tensor {shown(unknown[0])} is unexpected")
        for name, info in self.tensors.items():
            if info.dtype not in dtypes:
                raise UnsafeFileError(
                    f"tensor {name} has dtype {info.dtype}, expected {' or '.join(dtypes)}"
                )


def read_tensor_file(path: Path, limit_bytes: int) -> TensorFile:
    """Read a safetensors file of at most ``limit_bytes``.

    Raises:
        UnsafeFileError: it is not a regular file, too large, or has an invalid header.
        OSError: it is missing, or cannot be read.
    """
    return TensorFile.parse(read_bytes(path, limit_bytes))
