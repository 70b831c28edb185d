"""Every complete tick of a torn recording is recovered."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from egovcp.log.mcap_reader import read_recording
from egovcp.rate import NS_PER_S
from egovcp_deploy.mcap.cli import main
from egovcp_deploy.mcap.info import summarise

from .conftest import INFO, Record


def chunk_ends(path: Path) -> list[int]:
    """Sizes of the file just after each tick."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [chunk.chunk_start_offset + chunk.chunk_length for chunk in summary.chunk_indexes]


def test_every_complete_tick_of_a_torn_file_is_recovered(record: Record, tmp_path: Path) -> None:
    whole = record()
    content, ends = whole.read_bytes(), chunk_ends(whole)
    assert len(ends) == 8
    random = np.random.default_rng(0).integers(ends[0], len(content), 40).tolist()
    edges = [end + shift for end in ends for shift in (-1, 0, 1, 9)]
    expected = read_recording(whole).ticks
    for number, cut in enumerate([*edges, *random, len(content) - 1]):
        torn, out = tmp_path / f"torn-{number}.mcap", tmp_path / f"out-{number}.mcap"
        torn.write_bytes(content[:cut])
        assert main(["recover", str(torn), str(out)]) == 0
        recovered = read_recording(out)
        assert recovered.complete
        count = sum(end <= cut for end in ends)
        assert [tick.index for tick in recovered.ticks] == list(range(count))
        for before, after in zip(expected, recovered.ticks, strict=False):
            np.testing.assert_array_equal(before.depth, after.depth)
            np.testing.assert_array_equal(before.state, after.state)
        assert torn.read_bytes() == content[:cut]


def test_the_home_folder_is_expanded(
    record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    record("whole.mcap")
    assert main(["recover", "~/whole.mcap", "~/out.mcap"]) == 0
    assert main(["info", "~/out.mcap"]) == 0


def test_a_recovered_file_has_an_index(record: Record, tmp_path: Path) -> None:
    whole, torn = record(), tmp_path / "torn.mcap"
    torn.write_bytes(whole.read_bytes()[: chunk_ends(whole)[4] + 100])
    assert main(["recover", str(torn), str(tmp_path / "out.mcap")]) == 0
    with (tmp_path / "out.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert len(summary.chunk_indexes) == 5
    assert len(summary.metadata_indexes) == 2  # the second is a copy


def test_ticks_before_garbage_are_read(record: Record, tmp_path: Path) -> None:
    whole = record()
    ends = chunk_ends(whole)
    for number, seed in enumerate(range(20)):
        rng, content = np.random.default_rng(seed), bytearray(whole.read_bytes())
        at = int(rng.integers(ends[2], ends[3]))
        content[at : at + 64] = rng.bytes(64) if number else bytes(64)
        torn = tmp_path / f"{number}.mcap"
        torn.write_bytes(content)
        recording = read_recording(torn)
        assert len(recording.ticks) >= 3
        assert not recording.complete or len(recording.ticks) == 8


def test_nothing_is_overwritten(record: Record, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = record("a.mcap"), record("b.mcap")
    before = other.read_bytes()
    assert main(["recover", str(one), str(other)]) == 5
    assert "exists already" in capsys.readouterr().err
    assert other.read_bytes() == before


def test_info_reports_missing_ticks(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = record(missing=(3, 4))
    assert main(["info", str(file), f"--json={tmp_path / 'info.json'}"]) == 0
    out = capsys.readouterr().out
    assert "complete" in out
    assert "after tick 2: 2 missing" in out
    report = json.loads((tmp_path / "info.json").read_text())
    assert (report["ticks"], report["missing"], report["complete"]) == (6, 2, True)
    assert report["gaps"] == [{"after": 2, "missing": 2, "seconds": 0.12}]
    assert report["run"]["hashes"] == dict(INFO.hashes)
    assert report["topics"]["/head/depth"]["messages"] == 6
    assert report["rate_hz"] == pytest.approx(6 / 0.32)


def test_info_of_a_truncated_file_names_the_recovery(
    record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = record()
    file = whole.with_name("my run.mcap")
    file.write_bytes(whole.read_bytes()[:-20])
    assert main(["info", str(file)]) == 0
    out = capsys.readouterr().out
    assert "TRUNCATED" in out
    assert f"egovcp-mcap recover '{file}'" in out


def test_the_duration_counts_periods(record: Record) -> None:
    assert summarise(record())[0]["duration_s"] == 8 * 40_000_000 / NS_PER_S


def foreign(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("somebody", {"else": "s"})
        writer.finish()


def cut_before_the_metadata(path: Path) -> None:
    foreign(path)
    path.write_bytes(path.read_bytes()[:12])


WRONG = {
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_bytes(b"not an mcap file at all, but longer than magic"),
    "foreign": foreign,
    "stump": cut_before_the_metadata,
    "folder": lambda path: path.mkdir(),
    "missing": lambda path: None,
}


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("command", ["info", "recover", "to-dataset"])
def test_other_files_are_refused_in_one_line(
    kind: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "a.mcap", tmp_path / "out"
    WRONG[kind](path)
    more = {"recover": [str(out)], "to-dataset": [f"--dataset.root={out}"]}.get(command, [])
    assert main([command, str(path), *more]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert str(path) in line
    assert not out.exists()


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["dance"],
        ["info"],
        ["info", "a", "b"],
        ["recover", "a"],
        ["to-dataset"],
        ["to-dataset", "--gaps=mend", "a"],
        ["info", "a", "--nonsense=1"],
    ],
)
def test_invalid_usage_is_refused(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(args) == 2
