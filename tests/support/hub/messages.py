"""A request that has arrived and its response, independent of sockets."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import parse_qs

CHUNK = 1 << 20


@dataclass(frozen=True)
class Request:
    """A request of a client."""

    endpoint: str
    """The server's own address, for links."""
    parts: Mapping[str, str]
    """What the route's pattern found in the path, unquoted."""
    query: Mapping[str, str]
    headers: Mapping[str, str]
    """By name in lower case."""
    body: Iterator[bytes]

    def content(self) -> bytes:
        """The whole body."""
        return b"".join(self.body)

    def json(self) -> dict[str, Any]:
        """The body as a JSON object."""
        found: dict[str, Any] = json.loads(self.content() or b"{}")
        return found

    def form(self) -> dict[str, list[str]]:
        """The body as a submitted form."""
        return parse_qs(self.content().decode())

    @property
    def repo(self) -> str:
        """The repository that the path names: ``datasets/user/name``."""
        return f"{self.parts.get('kind', 'models')}/{self.parts['repo']}"


@dataclass(frozen=True)
class Response:
    """A response of the server: text in memory, or a range of a file."""

    status: int = 200
    body: bytes = b""
    headers: Mapping[str, str] = field(default_factory=dict)
    file: Path | None = None
    start: int = 0
    length: int = 0
    """Bytes of ``file`` from ``start`` on; the body's length without one."""

    @property
    def size(self) -> int:
        """Length of the body."""
        return self.length if self.file else len(self.body)

    def chunks(self, limit: int) -> Iterator[bytes]:
        """The first ``limit`` bytes of the body."""
        if self.file is None:
            yield self.body[:limit]
            return
        with self.file.open("rb") as file:
            file.seek(self.start)
            left = min(limit, self.length)
            while left > 0 and (chunk := file.read(min(CHUNK, left))):
                left -= len(chunk)
                yield chunk


def json_response(
    content: object, status: int = 200, headers: Mapping[str, str] | None = None
) -> Response:
    """A response in JSON."""
    kind = {"Content-Type": "application/json", **(headers or {})}
    return Response(status, json.dumps(content).encode(), kind)


def arriving(file: BinaryIO, headers: Mapping[str, str]) -> Iterator[bytes]:
    """The body of a request as it arrives, whatever way it is framed."""
    if headers.get("transfer-encoding", "").lower() == "chunked":
        while size := int(file.readline().split(b";")[0], 16):
            yield file.read(size)
            file.readline()
        file.readline()
        return
    left = int(headers.get("content-length") or 0)
    while left > 0 and (chunk := file.read(min(CHUNK, left))):
        left -= len(chunk)
        yield chunk
