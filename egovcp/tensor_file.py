"""Reads untrusted safetensors files."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from safetensors import SafetensorError, deserialize

from egovcp.decode import shown
from egovcp.files import UnsafeFileError, parse_json, read_bytes

HEADER_LIMIT_BYTES: Final = 1 << 20
"""Allowance for the header in the size limit of a file."""
_LENGTH_BYTES: Final = 8  # of the header, a little-endian integer before it


@dataclass(frozen=True)
class TensorFile:
    """A safetensors file in memory."""

    metadata: Mapping[str, str]
    dtypes: Mapping[str, str]
    """Tensor -> its dtype, ``"F32"``."""
    shapes: Mapping[str, tuple[int, ...]]
    content: bytes
    """The whole file; `safetensors.numpy.load` and `safetensors.torch.load` take it."""

    @classmethod
    def parse(cls, content: bytes) -> TensorFile:
        """Parse a file in memory.

        Raises:
            UnsafeFileError: it is not a safetensors file.
        """
        length = int.from_bytes(content[:_LENGTH_BYTES], "little")
        if length > HEADER_LIMIT_BYTES:
            raise UnsafeFileError(
                f"not a safetensors file, or its header of {length} bytes is longer than "
                f"{HEADER_LIMIT_BYTES}"
            )
        try:
            tensors = dict(deserialize(content))  # type: ignore[no-untyped-call]
        except SafetensorError as error:
            raise UnsafeFileError(f"not a safetensors file, or truncated: {error}") from error
        header = json.loads(content[_LENGTH_BYTES : _LENGTH_BYTES + length])  # checked by then
        return cls(
            metadata=header.get("__metadata__") or {},
            dtypes={name: tensor["dtype"] for name, tensor in tensors.items()},
            shapes={name: tuple(tensor["shape"]) for name, tensor in tensors.items()},
            content=content,
        )

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
        """Raise `UnsafeFileError` unless the file holds exactly these tensors."""
        self.require_names(shapes, dtypes)
        for name, shape in self.shapes.items():
            if shape != shapes[name]:
                raise UnsafeFileError(
                    f"tensor {name} has shape {list(shape)}, expected {list(shapes[name])}"
                )

    def require_names(self, names: Collection[str], dtypes: Collection[str] = ("F32",)) -> None:
        """As `require`, for any shape."""
        missing = [name for name in names if name not in self.shapes]
        unknown = [name for name in self.shapes if name not in names]
        if missing:
            raise UnsafeFileError(f"tensor {missing[0]} is missing")
        if unknown:
            raise UnsafeFileError(f"tensor {shown(unknown[0])} is unexpected")
        for name, dtype in self.dtypes.items():
            if dtype not in dtypes:
                raise UnsafeFileError(
                    f"tensor {name} has dtype {dtype}, expected {' or '.join(dtypes)}"
                )


def read_tensor_file(path: Path, limit_bytes: int) -> TensorFile:
    """Read a safetensors file of at most ``limit_bytes``.

    Raises:
        UnsafeFileError: it is not a regular file, too large, or not a safetensors file.
        OSError: it is missing, or cannot be read.
    """
    return TensorFile.parse(read_bytes(path, limit_bytes))
