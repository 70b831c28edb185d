"""A log behind the loop: nothing that happens to it reaches the loop, and nothing is hushed up."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.log.async_sink import AsyncFanout, AsyncSink
from egovcp.log.mcap import McapSink
from egovcp.log.mcap_reader import read_recording
from egovcp.log.tick import RunInfo
from egovcp.log.writer_process import Outbox
from tests.support.sinks import BrokenSink, FaultySink

INFO = RunInfo("ball")
type Start = Callable[..., AsyncSink]


@pytest.fixture
def warnings() -> list[str]:
    return []


@pytest.fixture
def start(warnings: list[str]) -> Iterator[Start]:
    """An open background sink around the given one; closed after the test."""
    sinks: list[AsyncSink] = []

    def start(sink: Any, **options: Any) -> AsyncSink:
        sinks.append(AsyncSink(sink, "the log", warn=warnings.append, **options))
        sinks[-1].open(INFO)
        return sinks[-1]

    yield start
    for sink in sinks:
        sink.close()


def lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines()


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    assert condition()


def test_calls_arrive_in_order(
    tmp_path: Path, start: Start, make_tick: Any, warnings: list[str]
) -> None:
    sink = start(FaultySink(tmp_path / "diary"))
    for index in range(40):
        sink.write(make_tick(index, bare=True))
    sink.close()
    ticks = [f"tick {index}" for index in range(40)]
    assert lines(tmp_path / "diary") == ["open ball", *ticks, "close"]
    assert (sink.dropped, sink.lost, sink.failure, warnings) == (0, 0, None, [])


def test_a_tick_may_change_after_write(tmp_path: Path, start: Start, make_tick: Any) -> None:
    sink = start(McapSink(tmp_path / "a.mcap"))
    tick = make_tick(0)
    depth = tick.depth.copy()
    sink.write(tick)
    tick.depth[:] = 0
    sink.close()
    recording = read_recording(tmp_path / "a.mcap")
    assert recording.complete
    assert (recording.ticks[0].depth == depth).all()


def test_dropped_ticks_are_counted_and_logged(
    tmp_path: Path, start: Start, make_tick: Any, warnings: list[str]
) -> None:
    diary = tmp_path / "diary"
    sink = start(FaultySink(diary), queue_ticks=3)
    os.kill(sink.pid, signal.SIGSTOP)
    index = -1
    while sink.dropped < 5:
        index += 1
        sink.write(make_tick(index, bare=True))
    os.kill(sink.pid, signal.SIGCONT)
    while not any("missing" in line for line in lines(diary)):
        index += 1
        sink.write(make_tick(index, bare=True))
        time.sleep(0.01)
    sink.close()
    words = [line.split() for line in lines(diary) if line.startswith("tick")]
    kept = [int(number) for _, number, *_ in words]
    assert kept == sorted(set(kept))
    assert index + 1 - len(kept) == sink.dropped
    gaps = [(int(number), int(event[0])) for _, number, *event in words if event]
    assert gaps == [(b, b - a - 1) for a, b in pairwise(kept) if b > a + 1]
    assert sink.lost == 0
    drops = f"{sink.dropped} of {index + 1} ticks were dropped"
    assert warnings == [f"the log: {drops}, 0 more may be missing at its end"]


def test_a_long_queue_survives_a_hanging_disk(
    tmp_path: Path, start: Start, make_tick: Any, warnings: list[str]
) -> None:
    sink = start(FaultySink(tmp_path / "diary"), close_timeout_s=60.0)
    os.kill(sink.pid, signal.SIGSTOP)
    for index in range(250):  # 10 s at 25 Hz
        sink.write(make_tick(index))
    os.kill(sink.pid, signal.SIGCONT)
    sink.close()
    assert sum(line.startswith("tick") for line in lines(tmp_path / "diary")) == 250
    assert (sink.dropped, warnings) == (0, [])


def test_close_times_out_on_a_hanging_disk(
    tmp_path: Path, start: Start, make_tick: Any, warnings: list[str]
) -> None:
    sink = start(FaultySink(tmp_path / "diary", stall_at=1, stall_s=200.0), close_timeout_s=0.3)
    for index in range(4):
        sink.write(make_tick(index, bare=True))
    until(lambda: "stall" in lines(tmp_path / "diary"))
    sink.close()
    assert sink.lost == 3
    assert warnings == [
        "the log: 0 of 4 ticks were dropped, 3 more may be missing at its end; it is not finished"
    ]


def test_a_file_that_is_not_finished_in_time_is_reported(
    tmp_path: Path, start: Start, make_tick: Any, warnings: list[str]
) -> None:
    sink = start(FaultySink(tmp_path / "diary", close_s=200.0), close_timeout_s=1.5)
    sink.write(make_tick(0, bare=True))
    sink.close()
    assert warnings == ["the log: not finished within 1.5 s; it is incomplete"]


def test_a_full_disk_is_reported_once(
    tmp_path: Path, start: Start, make_tick: Any, warnings: list[str]
) -> None:
    sink = start(FaultySink(tmp_path / "diary", raise_at=2))
    for index in range(3):
        sink.write(make_tick(index, bare=True))
    until(lambda: "close" in lines(tmp_path / "diary"))
    for index in range(3, 6):
        sink.write(make_tick(index, bare=True))
    assert isinstance(sink.failure, OSError)
    assert warnings == ["the log: No space left on device; the run continues without this log"]
    sink.close()
    assert sink.dropped + sink.lost == 4
    assert len(warnings) == 2


def test_an_error_that_cannot_be_unpickled_is_reported_as_text(
    start: Start, make_tick: Any, warnings: list[str]
) -> None:
    sink = start(BrokenSink())
    until(lambda: sink.write(make_tick(0, bare=True)) or sink.failure)
    assert warnings == ["the log: LibraryError: it broke; the run continues without this log"]


def test_a_killed_writer_is_reported_once(
    tmp_path: Path, start: Start, make_tick: Any, warnings: list[str]
) -> None:
    sink = start(FaultySink(tmp_path / "diary"))
    os.kill(sink.pid, signal.SIGKILL)
    os.waitid(os.P_PID, sink.pid, os.WEXITED | os.WNOWAIT)
    index = 0
    while sink.failure is None:
        sink.write(make_tick(index, bare=True))
        index += 1
        time.sleep(0.01)
    sink.write(make_tick(index, bare=True))
    assert warnings == [
        "the log: its writer process ended by signal 9; the run continues without this log"
    ]


def test_write_does_not_wait_for_the_end_of_the_writer(
    tmp_path: Path,
    start: Start,
    make_tick: Any,
    warnings: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(outbox: Outbox) -> None:
        raise BrokenPipeError

    sink, tick = start(FaultySink(tmp_path / "diary")), make_tick(0, bare=True)
    monkeypatch.setattr(Outbox, "pump", broken)
    begin = time.monotonic()
    sink.write(tick)
    assert time.monotonic() - begin < 0.5
    assert warnings == [
        "the log: its writer process closed the pipe; the run continues without this log"
    ]


def test_open_raises_the_error_of_the_sink(tmp_path: Path, warnings: list[str]) -> None:
    (tmp_path / "a.mcap").write_bytes(b"precious")
    sink = AsyncSink(McapSink(tmp_path / "a.mcap"), "the log", warn=warnings.append)
    with pytest.raises(EnvironmentFailure, match="exists already"):
        sink.open(INFO)
    sink.close()
    assert warnings == []


def test_a_hanging_sink_does_not_block_the_others(
    tmp_path: Path, make_tick: Any, warnings: list[str]
) -> None:
    sinks = [
        AsyncSink(FaultySink(tmp_path / "a", stall_at=0, stall_s=200.0), "a",
                       close_timeout_s=0.2, warn=warnings.append),
        AsyncSink(FaultySink(tmp_path / "b"), "b", warn=warnings.append),
    ]  # fmt: skip
    with closing(AsyncFanout(sinks)) as both:
        both.open(INFO)
        for index in range(3):
            both.write(make_tick(index, bare=True))
    assert lines(tmp_path / "b") == ["open ball", "tick 0", "tick 1", "tick 2", "close"]
    assert [line[:2] for line in warnings] == ["a:"]


def test_open_closes_all_sinks_if_one_fails(tmp_path: Path, warnings: list[str]) -> None:
    (tmp_path / "a.mcap").write_bytes(b"precious")
    sinks = [
        AsyncSink(FaultySink(tmp_path / "b"), "b", warn=warnings.append),
        AsyncSink(McapSink(tmp_path / "a.mcap"), "a", warn=warnings.append),
    ]
    with pytest.raises(EnvironmentFailure):
        AsyncFanout(sinks).open(INFO)
    assert lines(tmp_path / "b") == ["open ball", "close"]


_RUN = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from conftest import _tick
from egovcp.log.async_sink import AsyncSink
from egovcp.log.tick import RunInfo
from egovcp.log.mcap import McapSink
sink = McapSink(Path({path!r}))
sink = AsyncSink(sink, "log") if {background} else sink
sink.open(RunInfo("ball"))
for index in range(10_000):
    sink.write(_tick(index))
    print(index, flush=True)
    time.sleep(0.01)
"""


@pytest.mark.parametrize("background", [pytest.param(False, marks=pytest.mark.slow), True])
def test_kill_9_loses_less_than_a_second(tmp_path: Path, background: bool) -> None:
    path = tmp_path / "a.mcap"
    code = _RUN.format(tests=str(Path(__file__).parent), path=str(path), background=background)
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        said = [int(run.stdout.readline()) for _ in range(60)]
        run.kill()
        said += [int(line) for line in run.stdout]
    until(lambda: read_recording(path).complete == background)  # its process finishes the file
    recording = read_recording(path)
    assert [tick.index for tick in recording.ticks] == list(range(len(recording.ticks)))
    assert len(recording.ticks) >= said[-1] + 1 - 25
