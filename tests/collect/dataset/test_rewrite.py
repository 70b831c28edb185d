"""`egovcp-dataset merge` and `repair`: new datasets from the episodes of others."""

import hashlib
import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Provenance
from egovcp.testing import random_episode
from egovcp_collect.dataset.cli import main

from . import damage as d
from .conftest import COLLECTED, walk, write
from .damage import COLLECTION, DATA, EPISODES, INFO, MORE_DATA, STATS, TASKS
from .episodes import ARM

pytestmark = pytest.mark.usefixtures("no_network")


def _reader(root: Path) -> DatasetReader:
    return DatasetReader.open(DatasetConfig(root=str(root)))


def _digests(*roots: Path) -> list[str]:
    return [_reader(root).read(i).digest() for root in roots for i in range(len(_reader(root)))]


def test_merge_joins_two_collections(sound: Path, tmp_path: Path) -> None:
    more, new = write(tmp_path / "more", [6, 7]), tmp_path / "new"
    assert main(["merge", str(sound), str(more), f"--output_dir={new}"]) == 0
    assert _digests(new) == _digests(sound, more)
    assert main(["check", str(new)]) == 0
    merged = _reader(new)
    assert merged.provenance["config"] == _reader(sound).provenance["config"]
    assert [merged.identity(i).rpartition("/")[2] for i in range(8)] == [*"01234567"]


def test_merge_keeps_the_provenance_of_unequal_collections(sound: Path, tmp_path: Path) -> None:
    two = write(tmp_path / "two", [6, 7], Provenance("stance-1", 6, config={"eta": 0.1}))
    one = write(tmp_path / "one", [8], Provenance("stance-1", 7, config={"eta": 0.2}))
    assert main(["merge", str(sound), str(two), f"--output_dir={tmp_path / 'a'}"]) == 0
    assert main(["merge", str(tmp_path / "a"), str(one), f"--output_dir={tmp_path / 'b'}"]) == 0
    merged = _reader(tmp_path / "b")
    sources = merged.provenance["config"]["sources"]
    used = [sources[merged.metadata(i)["source"]] for i in range(9)]
    assert [source["config"]["eta"] for source in used] == [0.3] * 6 + [0.1] * 2 + [0.2]
    assert [source["seed"] for source in used] == [5] * 6 + [6] * 2 + [7]


def test_merge_refuses_or_drops_duplicates(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again, new = write(tmp_path / "again", [6, 4]), tmp_path / "new"
    flags = ["merge", str(sound), str(again), f"--output_dir={new}"]
    assert main(flags) == 3
    assert f"{again}, episode 1 equals {sound}, episode 4" in capsys.readouterr().err
    assert not new.exists()
    report = tmp_path / "report.json"
    assert main([*flags, "--duplicates=drop", f"--json={report}"]) == 0
    assert _digests(new) == [*_digests(sound), _digests(again)[0]]
    assert json.loads(report.read_text())["duplicates_dropped"] == 1


def test_the_recorded_command_repeats_the_merge(sound: Path, tmp_path: Path) -> None:
    other = write(tmp_path / "other", [6, 4], Provenance("stance-1", 6, config={"eta": 0.1}))
    new = tmp_path / "new"
    flags = [f"--output_dir={new}", "--duplicates=drop"]
    assert main(["merge", str(sound), str(other), *flags]) == 0
    command = _reader(new).provenance["command"]
    assert command == f"egovcp-dataset merge {sound} {other} --duplicates=drop"
    again = tmp_path / "again"
    assert main([*shlex.split(command)[1:], f"--output_dir={again}"]) == 0
    assert _digests(again) == _digests(new)


@pytest.mark.parametrize("duplicates", ["refuse", "drop"])
def test_merge_keeps_equal_numbers_of_other_configurations(
    sound: Path, tmp_path: Path, duplicates: str
) -> None:
    other, new = tmp_path / "other", tmp_path / "new"
    with DatasetWriter(other, Provenance("stance-1", seed=5, config={"eta": 0.1})) as writer:
        for n in (0, 1):
            writer.add(replace(walk(n + 10, 12), metadata={"seed": 5, "episode": n}))
    flags = [f"--output_dir={new}", f"--duplicates={duplicates}"]
    assert main(["merge", str(sound), str(other), *flags]) == 0
    assert _digests(new) == _digests(sound, other)
    assert main(["check", str(new)]) == 0


def test_merge_refuses_equal_scenarios_of_other_content(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other, new = tmp_path / "other", tmp_path / "new"
    with DatasetWriter(other, COLLECTED) as writer:
        writer.add(replace(walk(10, 12), metadata={"seed": 5, "episode": 0}))
    for duplicates in ("refuse", "drop"):
        flags = [f"--output_dir={new}", f"--duplicates={duplicates}"]
        assert main(["merge", str(sound), str(other), *flags]) == 3
        message = capsys.readouterr().err
        assert f"{other}, episode 0 is ball/5/0" in message
        assert f"{sound}, episode 0" in message
    assert not new.exists()


def test_merge_refuses_different_controllers(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write(tmp_path / "other", [6], Provenance("walk-2"))
    assert main(["merge", str(sound), str(other), f"--output_dir={tmp_path / 'new'}"]) == 3
    message = capsys.readouterr().err
    assert "walk-2" in message
    assert "stance-1" in message


def test_merge_of_damaged_data_leaves_no_folder(sound: Path, copy: Path, tmp_path: Path) -> None:
    d.flip_pixel(copy)
    more = write(tmp_path / "more", [6])
    assert main(["merge", str(more), str(copy), f"--output_dir={tmp_path / 'new'}"]) == 3
    assert {path.name for path in tmp_path.iterdir()} == {"copy", "more"}


@pytest.mark.parametrize("roots", [[], ["{sound}"]])
def test_merge_needs_two_datasets(
    roots: list[str], sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [root.format(sound=sound) for root in roots]
    assert main(["merge", *flags, f"--output_dir={tmp_path / 'new'}"]) == 2
    assert "two datasets" in capsys.readouterr().err


def _content(root: Path) -> dict[Path, str]:
    return {
        path: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in root.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize(
    ("damage", "kept", "dropped"),
    [
        (lambda root: None, [0, 1, 2, 3, 4, 5], []),
        (d.remove(INFO), [0, 1, 2, 3, 4, 5], []),
        (d.remove("meta/episodes"), [0, 1, 2, 3, 4, 5], []),
        (d.cut(DATA, 0.5), [3, 4, 5], [(DATA, 0), (DATA, 1), (DATA, 2)]),
        (d.swap(DATA, MORE_DATA), [3, 4, 5, 0, 1, 2], []),
        (d.flip_pixel, [0, 2, 3, 4, 5], [(DATA, 1)]),
        (d.column("episode_index", d.put(30, 7)), [0, 1, 3, 4, 5], [(DATA, 2), (DATA, 7)]),
        (d.record(1, sha256="0" * 64), [0, 2, 3, 4, 5], [(DATA, 1)]),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                (d.remove(STATS), [0, 1, 2, 3, 4, 5], []),
                (d.remove(TASKS), [0, 1, 2, 3, 4, 5], []),
                (d.cut(EPISODES, 0.5), [0, 1, 2, 3, 4, 5], []),
                (d.info(data_path="../{chunk_index}"), [0, 1, 2, 3, 4, 5], []),
                (d.remove(MORE_DATA), [0, 1, 2], [(MORE_DATA, 3), (MORE_DATA, 4), (MORE_DATA, 5)]),
                (d.column("next.reward", d.put(14, float("nan"))), [0, 2, 3, 4, 5], [(DATA, 1)]),
                (d.column("timestamp", d.put(14, 9.0)), [0, 2, 3, 4, 5], [(DATA, 1)]),
                (
                    d.column(spec.DEPTH_KEY, d.blob(14, lambda b: None)),
                    [0, 2, 3, 4, 5],
                    [(DATA, 1)],
                ),
                (d.record(1, task=""), [0, 2, 3, 4, 5], [(DATA, 1)]),
                (d.outside(DATA), [3, 4, 5], [(DATA, 0), (DATA, 1), (DATA, 2)]),
            )
        ),
    ],
)
def test_repair_keeps_sound_episodes_and_lists_the_others(
    damage: d.Damage, kept: list[int], dropped: list[tuple[str, int]], sound: Path, copy: Path,
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    damage(copy)
    before = _content(copy)
    new, report = tmp_path / "new", tmp_path / "report.json"
    assert main(["repair", str(copy), f"--output_dir={new}", f"--json={report}"]) == 0
    assert _content(copy) == before
    original = _digests(sound)
    assert _digests(new) == [original[i] for i in kept]
    found = json.loads(report.read_text())
    assert found["episodes"] == len(kept)
    named = {(p["file"], p["episode"]) for p in found["dropped"] if p["episode"] is not None}
    assert named == set(dropped)
    printed = capsys.readouterr().out
    assert all(f"{file}, episode {episode}" in printed for file, episode in dropped)
    assert main(["check", str(new)]) == 0


def test_repair_reads_row_groups_of_any_size(sound: Path, copy: Path, tmp_path: Path) -> None:
    table = pq.read_table(copy / DATA)
    pq.write_table(table, copy / DATA, row_group_size=5)
    assert main(["repair", str(copy), f"--output_dir={tmp_path / 'new'}"]) == 0
    assert _digests(tmp_path / "new") == _digests(sound)


def test_repair_without_readable_episodes_leaves_no_folder(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(copy / "data")
    new = tmp_path / "new"
    assert main(["repair", str(copy), f"--output_dir={new}"]) == 3
    assert "no episode of" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


@pytest.mark.parametrize("damage", [d.remove(COLLECTION), d.cut(COLLECTION, 0.5)])
def test_repair_without_records_needs_the_originals(
    damage: d.Damage, sound: Path, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(copy)
    new = tmp_path / "new"
    assert main(["repair", str(copy), f"--output_dir={new}"]) == 3
    assert "--records=ORIGINAL" in capsys.readouterr().err
    assert main(["repair", str(copy), f"--output_dir={new}", f"--records={sound}"]) == 0
    assert _digests(new) == _digests(sound)


@pytest.mark.parametrize("form", ["{a},{b}", "[{a}, {b}]"])
def test_records_are_taken_from_several_datasets(
    form: str, sound: Path, copy: Path, tmp_path: Path
) -> None:
    (copy / COLLECTION).unlink()
    other = write(tmp_path / "other", [6], Provenance("stance-1", 6, config={"eta": 0.1}))
    new = tmp_path / "new"
    records = f"--records={form.format(a=other, b=sound)}"
    assert main(["repair", str(copy), records, f"--output_dir={new}"]) == 0
    assert _digests(new) == _digests(sound)
    flags = shlex.split(_reader(new).provenance["command"])[3:]
    assert main(["repair", str(copy), *flags, f"--output_dir={tmp_path / 'again'}"]) == 0


def test_repair_says_that_the_robot_is_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, new = tmp_path / "arm", tmp_path / "new"
    with DatasetWriter(root, Provenance("arm-1")) as writer:
        writer.add(random_episode(0, robot=ARM))
    assert main(["repair", str(root), f"--output_dir={new}"]) == 0
    d.cut(INFO, 0.5)(root)
    assert main(["repair", str(root), f"--output_dir={tmp_path / 'other'}"]) == 3
    assert "meta/info.json is damaged, so the robot is unknown" in capsys.readouterr().err


def test_the_reader_suggests_repair(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (copy / COLLECTION).unlink()
    assert main(["info", str(copy)]) == 3
    assert f"egovcp-dataset repair {copy} --records=" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "--output_dir"),
        (["--output_dir={copy}/new"], "lies inside"),
        (["--output_dir={copy}"], "lies inside"),
        (["--output_dir={sound}"], "exists already"),
    ],
)
def test_repair_refuses_bad_destinations(
    flags: list[str], message: str, sound: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _content(copy)
    flags = [flag.format(copy=copy, sound=sound) for flag in flags]
    assert main(["repair", str(copy), *flags]) == 2
    assert message in capsys.readouterr().err
    assert _content(copy) == before
