"""Damaged recordings: `recover` keeps the readable ticks; other commands refuse the file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from egovcp.log.mcap_reader import RecordingReader, read_recording
from egovcp_deploy.mcap.cli import main

from .conftest import Record

TICKS = 8


def chunk_ranges(path: Path) -> list[range]:
    """The bytes of each tick's chunk."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [
        range(chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length)
        for chunk in summary.chunk_indexes
    ]


def flip(source: Path, target: Path, *positions: int, mask: int = 0xFF) -> Path:
    """A copy with some bytes changed."""
    content = bytearray(source.read_bytes())
    for position in positions:
        content[position] ^= mask
    target.write_bytes(content)
    return target


def messages(path: Path) -> dict[int, dict[str, bytes]]:
    return {
        raw.index: {topic: message.data for topic, message in raw.messages.items()}
        for raw in RecordingReader(path).raw_ticks()
    }


def test_a_flipped_byte_loses_at_most_its_tick(record: Record, tmp_path: Path) -> None:
    whole = record()
    expected, chunks = messages(whole), chunk_ranges(whole)
    random = np.random.default_rng(0)
    edges = [chunk[0] + shift for chunk in chunks for shift in (-1, 0, 1, 9, 25, 33, 37, 41)]
    ends = [0, 7, 8, 40, *range(whole.stat().st_size - 40, whole.stat().st_size)]
    for position in [*random.integers(0, whole.stat().st_size, 250).tolist(), *edges, *ends]:
        path = flip(whole, tmp_path / "b.mcap", position, mask=int(random.integers(1, 256)))
        reader = RecordingReader(path)
        kept = {
            raw.index: {topic: message.data for topic, message in raw.messages.items()}
            for raw in reader.raw_ticks()
        }
        lost = expected.keys() - kept.keys()
        assert lost <= {i for i, chunk in enumerate(chunks) if position in chunk}, position
        assert all(kept[i] == expected[i] for i in kept), position
        assert not reader.complete, position
        assert sum(loss.ticks or 0 for loss in reader.losses) == len(lost), position


def test_recover_keeps_the_ticks_on_both_sides_and_reports_the_loss(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = record()
    chunk = chunk_ranges(whole)[3]
    path, out = flip(whole, tmp_path / "b.mcap", chunk[100]), tmp_path / "out.mcap"
    assert main(["recover", str(path), str(out)]) == 0
    printed = capsys.readouterr().out
    assert "7 ticks" in printed
    assert "1 tick is lost (tick 3 between 0.08 and 0.16 s)" in printed
    recovered = read_recording(out)
    assert recovered.complete
    assert [tick.index for tick in recovered.ticks] == [0, 1, 2, 4, 5, 6, 7]


def test_recover_reports_every_damaged_place(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = record()
    chunks = chunk_ranges(whole)
    hits = [chunks[i][200] for i in (0, 3, 4, 7)]
    path = flip(whole, tmp_path / "b.mcap", *hits)
    assert main(["recover", str(path), str(tmp_path / "out.mcap")]) == 0
    printed = capsys.readouterr().out
    assert "4 ticks are lost (tick 0, ticks 3 to 4 between 0.08 and 0.20 s, tick 7)" in printed
    assert sorted(messages(tmp_path / "out.mcap")) == [1, 2, 5, 6]


def test_a_range_of_zeros_loses_the_ticks_in_it(record: Record, tmp_path: Path) -> None:
    whole = record()
    chunks, content = chunk_ranges(whole), bytearray(whole.read_bytes())
    content[chunks[2][50] : chunks[4][50]] = bytes(chunks[4][50] - chunks[2][50])
    (tmp_path / "b.mcap").write_bytes(content)
    reader = RecordingReader(tmp_path / "b.mcap")
    assert [raw.index for raw in reader.raw_ticks()] == [0, 1, 5, 6, 7]
    assert [loss.ticks for loss in reader.losses] == [3]


def test_a_torn_file_is_also_searched_for_damage(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = record()
    chunks = chunk_ranges(whole)
    path = flip(whole, tmp_path / "b.mcap", chunks[2][100])
    path.write_bytes(path.read_bytes()[: chunks[6][60]])
    path = flip(path, path, chunks[4][70])
    assert main(["recover", str(path), str(tmp_path / "out.mcap")]) == 0
    printed = capsys.readouterr().out
    assert "2 ticks are lost (tick 2 between 0.04 and 0.12 s, tick 4 between" in printed
    assert "and its end is missing" in printed
    assert sorted(messages(tmp_path / "out.mcap")) == [0, 1, 3, 5]


@pytest.mark.parametrize("command", ["info", "to-dataset"])
def test_a_damaged_recording_is_refused_with_the_remedy(
    command: str, record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = record()
    path = flip(whole, tmp_path / "b.mcap", chunk_ranges(whole)[3][100])
    more = [f"--dataset.root={tmp_path / 'new'}"] if command == "to-dataset" else []
    assert main([command, str(path), *more]) == 3
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert "1 tick is lost (tick 3" in line
    assert f"egovcp-mcap recover {path}" in line
    if command == "info":
        assert re.search(r"ticks +7 ", printed.out)
    assert [p.name for p in tmp_path.iterdir()] in (["a.mcap", "b.mcap"], ["b.mcap", "a.mcap"])


def test_damaged_metadata_is_taken_from_its_copy(record: Record, tmp_path: Path) -> None:
    whole = record()
    content = whole.read_bytes()
    for word in (b"stance-1", b"egovcp", b'"ball', b"features"):
        position = content.find(word, content.find(b"\x06\x00\x00\x00egovcp\x00"[:10]))
        path = flip(whole, tmp_path / "b.mcap", position, mask=1)
        reader = RecordingReader(path)
        assert reader.info == RecordingReader(whole).info
        assert len(list(reader.raw_ticks())) == TICKS
        assert reader.damaged


def test_metadata_damaged_in_both_copies_is_refused(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = record()
    content = whole.read_bytes()
    first = content.find(b"stance-1")
    path = flip(whole, tmp_path / "b.mcap", first, content.find(b"stance-1", first + 1))
    assert main(["recover", str(path), str(tmp_path / "out.mcap")]) == 3
    assert "metadata record 'egovcp' is damaged" in capsys.readouterr().err
    assert not (tmp_path / "out.mcap").exists()


def test_a_damaged_size_allocates_nothing(record: Record, tmp_path: Path) -> None:
    from tests.support.limited import run_limited

    whole = record()
    chunk = chunk_ranges(whole)[3]
    sizes = [chunk[0] + offset for offset in (8, 7, 32, 31, 48, 47, 54)]
    for position in sizes:
        path = flip(whole, tmp_path / f"{position}.mcap", position)
        out = tmp_path / f"out-{position}.mcap"
        call = ["recover", str(path), str(out)]
        result = run_limited(lambda call=call: main(call), seconds=20, memory_bytes=1 << 29)
        assert (result.exit_code, result.has_traceback) == (0, False), result.output
        assert len(messages(out)) >= TICKS - 1
