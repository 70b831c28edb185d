"""Where a Rerun recording goes: into a file, or to a viewer that is running."""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import rerun as rr
import rerun.blueprint as rrb

from egovcp.errors import EnvironmentFailure, UsageError

LOOPBACK: Final = "127.0.0.1"
GRPC_PORT: Final = 9876  # Rerun's own
_URL: Final = re.compile(r"rerun\+http://([\w.-]+):(\d{1,5})/proxy", re.ASCII)
_ANSWER_S: Final = 2.0


class Destination(Protocol):
    """Takes a recording from its first message on."""

    @property
    def is_live(self) -> bool:
        """Whether somebody is looking."""
        ...

    def attach(self, stream: rr.RecordingStream, look: rrb.Blueprint) -> None:
        """Send the stream there; ``look`` is how it is shown.

        Raises:
            EnvironmentFailure: it cannot be.
        """
        ...


@dataclass(frozen=True)
class RrdFile:
    """A new file."""

    path: Path

    @property
    def is_live(self) -> bool:
        """A file is looked at later."""
        return False

    def attach(self, stream: rr.RecordingStream, look: rrb.Blueprint) -> None:
        """Create the file; raises `EnvironmentFailure` when it exists or cannot be created."""
        if self.path.exists():
            raise EnvironmentFailure(
                f"{self.path} exists already; recordings are never overwritten: choose another"
            )
        try:
            stream.save(self.path, default_blueprint=look)
        except RuntimeError as error:  # Rerun has no other type for it
            raise EnvironmentFailure(f"cannot create {self.path}: {error}") from error


@dataclass(frozen=True)
class Viewer:
    """A viewer, or a server for several, at ``rerun+http://HOST:PORT/proxy``.

    Raises:
        UsageError: the address has another form.
    """

    url: str = f"rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy"

    def __post_init__(self) -> None:
        if not _URL.fullmatch(self.url):
            raise UsageError(
                f"{self.url!r} is no address of a Rerun viewer; "
                f"expected rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy or the like"
            )

    @property
    def is_live(self) -> bool:
        """Somebody may be looking."""
        return True

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        match = _URL.fullmatch(self.url)
        assert match is not None
        return match[1], int(match[2])

    @property
    def answers(self) -> bool:
        """Whether something listens there."""
        try:
            with socket.create_connection(self.address, timeout=_ANSWER_S):
                return True
        except OSError:
            return False

    def attach(self, stream: rr.RecordingStream, look: rrb.Blueprint) -> None:
        """Connect; raises `EnvironmentFailure` where nobody listens."""
        if not self.answers:
            raise EnvironmentFailure(
                f"no Rerun viewer answers at {self.url}; "
                f"start one: rerun --bind {LOOPBACK} --port {self.address[1]}"
            )
        stream.connect_grpc(self.url, default_blueprint=look)
