"""Recordings on a full disk, and how often they are synchronised."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from egovcp.log import mcap
from egovcp.log.async_sink import AsyncSink
from egovcp.log.mcap import McapSink
from egovcp.log.mcap_reader import read_recording
from egovcp.log.rerun import RerunSink
from egovcp.log.tick import RunInfo

MOST_TICKS = 2000  # a few hundred fill the disk


def test_the_file_is_synchronised_once_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_tick: Any
) -> None:
    now, synced = [0.0], []
    monkeypatch.setattr(mcap.time, "monotonic", lambda: now[0])
    sink = McapSink(tmp_path / "a.mcap")
    sink.open(RunInfo("ball"))
    monkeypatch.setattr(mcap.os, "fsync", lambda descriptor: synced.append(now[0]))
    for tick in range(76):
        now[0] = tick * 0.04
        sink.write(make_tick(tick, bare=True))
    assert synced == [1.0, 2.0, 3.0]
    sink.close()
    assert len(synced) == 4


def test_a_full_disk_keeps_all_written_ticks(small: Path, make_tick: Any) -> None:
    lines: list[str] = []
    sink = AsyncSink(McapSink(small / "a.mcap"), "a.mcap", queue_ticks=10**6, warn=lines.append)
    sink.open(RunInfo("ball"))
    for index in range(MOST_TICKS):
        sink.write(make_tick(index))
        if sink.failure is not None:
            break
    else:
        pytest.fail("no failure")
    sink.write(make_tick(index + 1))
    sink.close()
    recording = read_recording(small / "a.mcap")
    assert not recording.complete
    assert [tick.index for tick in recording.ticks] == list(range(len(recording.ticks)))
    assert len(recording.ticks) + sink.lost + sink.dropped == index + 2
    assert lines[0] == "a.mcap: No space left on device; the run continues without this log"
    assert len(lines) == 2


def test_a_full_disk_under_rerun_is_reported_once(small: Path, make_tick: Any) -> None:
    lines: list[str] = []
    rerun = RerunSink(small / "a.rrd", meshes=False)
    sink = AsyncSink(rerun, "a.rrd", queue_ticks=10**6, warn=lines.append)
    sink.open(RunInfo("ball"))
    for index in range(MOST_TICKS):
        sink.write(make_tick(index))
        if sink.failure is not None:
            break
    else:
        pytest.fail("no failure")
    sink.close()
    assert "disk full" in lines[0]
    assert "the run continues without this log" in lines[0]
    assert len(lines) == 2
