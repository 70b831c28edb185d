"""Rerun viewers: their addresses, and processes that `LiveRerun` starts.

A started viewer is a separate process that listens on the loopback only. To view it from another
machine, forward both ports: ``ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 ROBOT``.

    with LiveRerun.of("web") as live:
        sink = AsyncSink(RerunSink(live.viewer), "Rerun")
"""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Final, Literal, Self

import rerun as rr
import rerun.blueprint as rrb

from egovcp.errors import EnvironmentFailure, UsageError

LOOPBACK: Final = "127.0.0.1"
GRPC_PORT: Final = 9876  # Rerun's default
WEB_PORT: Final = 9090
_URL: Final = re.compile(r"rerun\+http://([\w.-]+):(\d{1,5})/proxy", re.ASCII)
_ANSWER_S: Final = 2.0
_START_TIMEOUT_S: Final = 30.0
_END_TIMEOUT_S: Final = 3.0


@dataclass(frozen=True)
class Viewer:
    """A viewer, or a server for several, at ``rerun+http://HOST:PORT/proxy``."""

    url: str = f"rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy"

    def __post_init__(self) -> None:
        if not _URL.fullmatch(self.url):
            raise UsageError(
                f"{self.url!r} is no address of a Rerun viewer; "
                f"expected rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy or the like"
            )

    @property
    def address(self) -> tuple[str, int]:
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

    def attach(self, stream: rr.RecordingStream, layout: rrb.Blueprint) -> None:
        """Send the stream to the viewer; raises `EnvironmentFailure` if none listens."""
        if not self.answers:
            raise EnvironmentFailure(
                f"no Rerun viewer answers at {self.url}; "
                f"start one: rerun --bind {LOOPBACK} --port {self.address[1]}"
            )
        stream.connect_grpc(self.url, default_blueprint=layout)


type Kind = Literal["spawn", "web", "connect"]


@dataclass
class LiveRerun:
    """A viewer process.

    ``spawn``: the native viewer, which stays open after the run. ``web``: a server for browsers,
    which ends with this process (after SIGKILL only if util-linux is installed); `page` is its
    URL. ``connect``: a viewer that runs already.
    """

    kind: Kind
    viewer: Viewer = field(default_factory=Viewer)
    """Destination of recordings."""
    web_port: int = WEB_PORT
    """Port of the web page."""
    _process: subprocess.Popen[bytes] | None = None

    @staticmethod
    def of(words: str) -> LiveRerun:
        """``spawn``, ``web``, or the address of a viewer that runs."""
        if words == "spawn":
            return LiveRerun("spawn")
        return LiveRerun("web") if words == "web" else LiveRerun("connect", Viewer(words))

    @property
    def page(self) -> str:
        if self.kind != "web":
            return ""
        port = self.viewer.address[1]
        proxy = f"rerun%2Bhttp%3A%2F%2F{LOOPBACK}%3A{port}%2Fproxy"
        return f"http://{LOOPBACK}:{self.web_port}/?url={proxy}"

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process else None

    def __enter__(self) -> Self:
        """Start the viewer and wait until it listens; call it from the main thread."""
        if self.kind == "connect":
            return self
        ports = [self.viewer.address[1], *([self.web_port] if self.kind == "web" else [])]
        for port in ports:
            _require_free(port)
        program, flags = str(_program()), self._flags()
        self._process = subprocess.Popen(
            [*(_ended_with_parent() if self.kind == "web" else []), program, *flags],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            self._await(ports)
        except BaseException:  # then `__exit__` is not called
            self._end()
            raise
        return self

    def __exit__(self, *details: object) -> None:
        """Stop the web server; a native viewer stays open."""
        if self.kind == "web":
            self._end()

    def _flags(self) -> list[str]:
        flags = ["--bind", LOOPBACK, "--port", str(self.viewer.address[1])]
        if self.kind == "web":
            return [*flags, "--serve-web", "--web-viewer-port", str(self.web_port)]
        return [*flags, "--expect-data-soon"]

    def _await(self, ports: list[int]) -> None:
        end = time.monotonic() + _START_TIMEOUT_S
        while not all(Viewer(_url(port)).answers for port in ports):
            assert self._process is not None
            code = self._process.poll()
            if code is not None or time.monotonic() > end:
                how = "was not ready in time" if code is None else f"ended with code {code}"
                raise EnvironmentFailure(
                    f"the Rerun viewer {how}; on a machine without a display use the web viewer, "
                    "or connect to a viewer that runs"
                )
            time.sleep(0.05)

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(_END_TIMEOUT_S)
            process.kill()
            process.wait(_END_TIMEOUT_S)


def _program() -> Path:
    """Path of the viewer; ``python -m rerun`` would start it as a grandchild."""
    found = find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise EnvironmentFailure("the viewer comes with rerun-sdk, which is not installed")
    return Path(found.origin).with_name("rerun")


def _url(port: int) -> str:
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def _ended_with_parent() -> list[str]:
    """Prefix of a command, which the kernel then kills with the thread that started it; empty where
    util-linux is missing."""
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "KILL"] if setpriv else []


def _require_free(port: int) -> None:
    """Raise `EnvironmentFailure` if something listens on the loopback port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise EnvironmentFailure(
                f"port {port} is in use, perhaps by a running viewer: to send to that viewer, "
                f"give its address, {_url(port) if port != WEB_PORT else _url(GRPC_PORT)}"
            ) from error
