"""A file that ends with a whole piece, on a disk that is too small, too."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from egovcp.log import mcap
from egovcp.log.async_sink import AsyncSink
from egovcp.log.mcap import AppendFile, McapSink
from egovcp.log.mcap_reader import read_recording
from egovcp.log.rerun import RerunSink
from egovcp.log.tick import RunInfo


def test_flush_writes_the_buffer(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a")
    file.write(b"one")
    file.write(b"two")
    assert (tmp_path / "a").read_bytes() == b""
    assert file.tell() == 6
    file.flush()
    assert (tmp_path / "a").read_bytes() == b"onetwo"
    file.close()


def test_a_failed_flush_leaves_the_file_unchanged(small: Path) -> None:
    file = AppendFile(small / "a")
    file.write(b"whole")
    file.flush()
    file.write(bytes(1 << 21))
    for end in (file.flush, file.flush, file.close):
        with pytest.raises(OSError, match="No space left"):
            end()
        assert (small / "a").read_bytes() == b"whole"


def test_a_later_flush_writes_what_did_not_fit(small: Path) -> None:
    filler = small / "filler"
    filler.write_bytes(bytes(700_000))
    file = AppendFile(small / "a")
    file.write(b"x" * 500_000)
    with pytest.raises(OSError, match="No space left"):
        file.flush()
    file.write(b"y")
    assert file.tell() == 500_001
    filler.unlink()
    file.flush()
    file.close()
    assert (small / "a").read_bytes() == b"x" * 500_000 + b"y"


def test_the_file_is_synchronised_once_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, synced = [0.0], []
    monkeypatch.setattr(mcap.time, "monotonic", lambda: now[0])
    file = AppendFile(tmp_path / "a")
    monkeypatch.setattr(mcap.os, "fsync", lambda descriptor: synced.append(now[0]))
    for tick in range(76):
        now[0] = tick * 0.04
        file.write(b"tick")
        file.flush()
    assert synced == [1.0, 2.0, 3.0]
    file.close()
    assert len(synced) == 4


def test_a_full_disk_keeps_all_written_ticks(small: Path, make_tick: Any) -> None:
    lines: list[str] = []
    sink = AsyncSink(McapSink(small / "a.mcap"), "a.mcap", lossless=True, warn=lines.append)
    sink.open(RunInfo("ball"))
    index = 0
    while sink.failure is None:
        sink.write(make_tick(index))
        index += 1
    sink.write(make_tick(index))
    sink.close()
    recording = read_recording(small / "a.mcap")
    assert not recording.complete
    assert [tick.index for tick in recording.ticks] == list(range(len(recording.ticks)))
    assert len(recording.ticks) + sink.lost + sink.dropped == index + 1
    assert lines[0] == "a.mcap: No space left on device; the run goes on without this log"
    assert len(lines) == 2


def test_a_disk_full_for_10_s_loses_nothing(small: Path, make_tick: Any) -> None:
    lines: list[str] = []
    sink = AsyncSink(McapSink(small / "a.mcap"), "a.mcap", close_timeout_s=60.0, warn=lines.append)
    sink.open(RunInfo("ball"))
    written = 0

    def write(ticks: int) -> None:
        nonlocal written
        for _ in range(ticks):
            sink.write(make_tick(written, bare=True))
            written += 1

    while not lines:
        write(1)
        time.sleep(0.002)
    write(250)  # 10 s at 25 Hz
    subprocess.run(["mount", "-o", "remount,size=64m", str(small)], check=True)
    while len(lines) < 2:
        write(1)
        time.sleep(0.05)
    sink.close()
    assert lines == [
        "a.mcap: No space left on device; ticks wait until there is room",
        "a.mcap: there is room again",
    ]
    recording = read_recording(small / "a.mcap")
    assert recording.complete
    assert [tick.index for tick in recording.ticks] == list(range(written))


def test_close_does_not_wait_for_a_full_disk(small: Path, make_tick: Any) -> None:
    lines: list[str] = []
    sink = AsyncSink(
        McapSink(small / "a.mcap"),
        "a.mcap",
        queue_ticks=20,
        close_timeout_s=0.5,
        warn=lines.append,
    )
    sink.open(RunInfo("ball"))
    index = 0
    while sink.dropped < 50:
        sink.write(make_tick(index))
        index += 1
    sink.close()
    recording = read_recording(small / "a.mcap")
    assert not recording.complete
    assert [tick.index for tick in recording.ticks] == list(range(len(recording.ticks)))
    assert len(recording.ticks) + sink.lost + sink.dropped == index
    assert lines[0] == "a.mcap: No space left on device; ticks wait until there is room"
    assert f"{sink.dropped} of {index} ticks were dropped" in lines[1]
    assert len(lines) == 2


def test_a_full_disk_under_rerun_is_reported_once(small: Path, make_tick: Any) -> None:
    lines: list[str] = []
    rerun = RerunSink(small / "a.rrd", meshes=False)
    sink = AsyncSink(rerun, "a.rrd", lossless=True, warn=lines.append)
    sink.open(RunInfo("ball"))
    index = 0
    while sink.failure is None:
        sink.write(make_tick(index))
        index += 1
    sink.close()
    assert "disk full" in lines[0]
    assert "the run goes on without this log" in lines[0]
    assert len(lines) == 2
