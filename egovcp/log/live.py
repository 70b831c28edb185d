"""A Rerun viewer beside the run: the native one, or a server for browsers.

It runs in a process of its own and listens on the loopback only; for remote eyes, forward both
ports: ``ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 ROBOT``.

    with LiveRerun.of("web") as live:
        sink = BackgroundSink(RerunSink(live.viewer), "Rerun")
"""

from __future__ import annotations

import socket
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Final, Literal, Self

from egovcp.errors import EnvironmentFailure
from egovcp.log.destination import GRPC_PORT, LOOPBACK, Viewer
from egovcp.parent_death import command

WEB_PORT: Final = 9090
_START_TIMEOUT_S: Final = 30.0
_END_TIMEOUT_S: Final = 3.0

type Kind = Literal["spawn", "web", "connect"]


@dataclass
class LiveRerun:
    """A viewer that is started by `start`, unless it runs already (``connect``).

    ``spawn``: the native viewer, which stays open after the run. ``web``: a server that ends
    with the run, however the run ends; `page` is what to open in a browser.
    """

    kind: Kind
    viewer: Viewer = field(default_factory=Viewer)
    """Where recordings are sent."""
    web_port: int = WEB_PORT
    """Port of the web page."""
    _process: subprocess.Popen[bytes] | None = None

    @staticmethod
    def of(words: str) -> LiveRerun:
        """``spawn``, ``web``, or the address of a viewer that runs.

        Raises:
            UsageError: none of these.
        """
        if words == "spawn":
            return LiveRerun("spawn")
        return LiveRerun("web") if words == "web" else LiveRerun("connect", Viewer(words))

    @property
    def page(self) -> str:
        """The web page that shows what is sent; empty without a server for it."""
        if self.kind != "web":
            return ""
        port = self.viewer.address[1]
        proxy = f"rerun%2Bhttp%3A%2F%2F{LOOPBACK}%3A{port}%2Fproxy"
        return f"http://{LOOPBACK}:{self.web_port}/?url={proxy}"

    @property
    def pid(self) -> int | None:
        """Number of the process that was started."""
        return self._process.pid if self._process else None

    def start(self) -> None:
        """Start the viewer and wait until it listens; call it from a thread that lasts.

        Raises:
            EnvironmentFailure: a port is in use, or the viewer ends at once (no display?).
        """
        if self.kind == "connect":
            return
        ports = [self.viewer.address[1], *([self.web_port] if self.kind == "web" else [])]
        for port in ports:
            _require_free(port)
        program, flags = str(_program()), self._flags()
        self._process = subprocess.Popen(
            command(program, *flags) if self.kind == "web" else [program, *flags],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._await(ports)

    def close(self) -> None:
        """End the web server; a native viewer stays open."""
        if self.kind == "web":
            self._end()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

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
                self._end()
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
    """The viewer itself: ``python -m rerun`` would start it as a child that outlives it."""
    found = find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise EnvironmentFailure("the viewer comes with rerun-sdk, which is not installed")
    return Path(found.origin).with_name("rerun")


def _url(port: int) -> str:
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def _require_free(port: int) -> None:
    """Raise `EnvironmentFailure` if something listens on the loopback port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise EnvironmentFailure(
                f"port {port} is in use, perhaps by a viewer that runs already: to send to that, "
                f"give its address, {_url(port) if port != WEB_PORT else _url(GRPC_PORT)}"
            ) from error
