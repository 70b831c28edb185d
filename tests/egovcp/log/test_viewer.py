"""A live viewer: on the loopback only, and never able to hold up the run."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.log.async_sink import AsyncSink
from egovcp.log.rerun import RerunSink
from egovcp.log.tick import RunInfo
from egovcp.log.viewer import LiveRerun, Viewer
from tests.support.ports import free_port

INFO = RunInfo("ball")


def address(port: int) -> str:
    return f"rerun+http://127.0.0.1:{port}/proxy"


@pytest.fixture
def web() -> Iterator[LiveRerun]:
    with LiveRerun("web", Viewer(address(free_port())), free_port()) as live:
        yield live


def connection(live: LiveRerun, warnings: list[str], **options: Any) -> AsyncSink:
    """An open recording that goes to the viewer."""
    sink = AsyncSink(RerunSink(live.viewer, meshes=False), "Rerun", warn=warnings.append, **options)
    sink.open(INFO)
    return sink


def test_the_viewer_listens_on_the_loopback_only(web: LiveRerun, make_tick: Any) -> None:
    sink = connection(web, [])
    sink.write(make_tick(0))
    mine = psutil.Process()
    listening = [
        c.laddr
        for process in (mine, *mine.children(recursive=True))
        for c in process.net_connections(kind="inet")
        if c.status == psutil.CONN_LISTEN
    ]
    sink.close()
    assert {a.port for a in listening} == {web.viewer.address[1], web.web_port}
    assert {a.ip for a in listening} == {"127.0.0.1"}


def test_an_interrupt_while_the_viewer_starts_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    live, started = LiveRerun("spawn", Viewer(address(free_port()))), list[psutil.Process]()

    def interrupt(self: LiveRerun, ports: list[int]) -> None:
        started.append(psutil.Process(self.pid))
        raise KeyboardInterrupt

    monkeypatch.setattr(LiveRerun, "_await", interrupt)
    with pytest.raises(KeyboardInterrupt), live:
        pass
    assert [process.is_running() for process in started] == [False]


def test_ticks_arrive_and_the_server_ends_with_the_run(web: LiveRerun, make_tick: Any) -> None:
    warnings: list[str] = []
    sink = connection(web, warnings)
    for index in range(5):
        sink.write(make_tick(index))
    sink.close()
    assert (sink.lost, sink.dropped, warnings) == (0, 0, [])
    assert str(web.web_port) in web.page
    assert web.pid is not None
    process = psutil.Process(web.pid)
    web.__exit__()
    assert not process.is_running()


@pytest.mark.slow
def test_a_killed_viewer_is_reported_once(web: LiveRerun, make_tick: Any) -> None:
    warnings: list[str] = []
    sink = connection(web, warnings)
    assert web.pid is not None
    os.kill(web.pid, signal.SIGKILL)
    index, end = 0, time.monotonic() + 60
    while sink.failure is None and time.monotonic() < end:
        sink.write(make_tick(index, bare=True))
        index += 1
        time.sleep(0.02)
    sink.close()
    assert isinstance(sink.failure, EnvironmentFailure)
    assert "cannot send the recording" in warnings[0]
    assert "the run continues without this log" in warnings[0]
    assert len(warnings) == 2


def test_a_hanging_viewer_does_not_block_close(web: LiveRerun, make_tick: Any) -> None:
    warnings: list[str] = []
    sink = connection(web, warnings, close_timeout_s=0.5)
    pid = sink.pid
    assert web.pid is not None
    os.kill(web.pid, signal.SIGSTOP)
    for index in range(60):
        sink.write(make_tick(index))
    sink.close()
    os.kill(web.pid, signal.SIGCONT)
    assert not psutil.pid_exists(pid)
    assert len(warnings) == 1


_RUN = """
import sys, time
from contextlib import closing
from pathlib import Path
sys.path.insert(0, {tests!r})
from conftest import _tick
from egovcp.log.async_sink import AsyncFanout, AsyncSink
from egovcp.log.viewer import Viewer
from egovcp.log.tick import RunInfo
from egovcp.log.viewer import LiveRerun
from egovcp.log.mcap import McapSink
from egovcp.log.rerun import RerunSink
folder = Path({folder!r})
with LiveRerun("web", Viewer({address!r}), {port}) as live:
    sinks = [
        AsyncSink(McapSink(folder / "a.mcap"), "a.mcap"),
        AsyncSink(RerunSink(folder / "a.rrd"), "a.rrd"),
        AsyncSink(RerunSink(live.viewer), "Rerun"),
    ]
    with closing(AsyncFanout(sinks)) as log:
        log.open(RunInfo("ball"))
        for index in range(10_000):
            log.write(_tick(index))
            print(index, flush=True)
            time.sleep(0.04)
"""


@pytest.mark.slow
def test_no_process_survives_a_killed_run(tmp_path: Path) -> None:
    tests, ports = str(Path(__file__).parent), (free_port(), free_port())
    code = _RUN.format(tests=tests, folder=str(tmp_path), address=address(ports[0]), port=ports[1])
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        while int(run.stdout.readline()) < 20:
            pass
        children = psutil.Process(run.pid).children(recursive=True)
        run.kill()
        _, left = psutil.wait_procs(children, timeout=30)
    assert len(children) == 4  # three writers and the server
    assert left == []


def test_a_viewer_that_does_not_run_is_an_error(tmp_path: Path) -> None:
    sink = AsyncSink(RerunSink(Viewer(address(free_port())), meshes=False), "Rerun")
    with pytest.raises(EnvironmentFailure, match="no Rerun viewer answers"):
        sink.open(INFO)


def test_a_port_in_use_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        live = LiveRerun("web", Viewer(address(free_port())), web_port=port)
        with pytest.raises(EnvironmentFailure, match=f"port {port} is in use"), live:
            pass


@pytest.mark.parametrize("words", ["", "http://127.0.0.1:9876", "rerun+http://a b:1/proxy", "x"])
def test_other_addresses_are_refused(words: str) -> None:
    with pytest.raises(UsageError, match="expected rerun"):
        LiveRerun.of(words)
