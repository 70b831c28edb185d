"""One dataset out of several: every episode as it was, with its own facts."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Provenance
from egovcp_collect.dataset.cli import main

from . import damage
from .conftest import COLLECTED, walk, write


def _reader(root: Path) -> DatasetReader:
    return DatasetReader.open(DatasetConfig(root=str(root)))


def _digests(*roots: Path) -> list[str]:
    return [_reader(root).read(i).digest() for root in roots for i in range(len(_reader(root)))]


def test_two_collections_become_one_sound_dataset(sound: Path, tmp_path: Path) -> None:
    more, new = write(tmp_path / "more", [6, 7]), tmp_path / "new"
    assert main(["merge", str(sound), str(more), f"--output_dir={new}"]) == 0
    assert _digests(new) == _digests(sound, more)
    assert main(["check", str(new)]) == 0
    merged = _reader(new)
    assert merged.provenance["config"] == _reader(sound).provenance["config"]
    assert [merged.identity(i).rpartition("/")[2] for i in range(8)] == [*"01234567"]


def test_unequal_collections_keep_what_each_was(sound: Path, tmp_path: Path) -> None:
    two = write(tmp_path / "two", [6, 7], Provenance("stance-1", 6, config={"eta": 0.1}))
    one = write(tmp_path / "one", [8], Provenance("stance-1", 7, config={"eta": 0.2}))
    assert main(["merge", str(sound), str(two), f"--output_dir={tmp_path / 'a'}"]) == 0
    assert main(["merge", str(tmp_path / "a"), str(one), f"--output_dir={tmp_path / 'b'}"]) == 0
    merged = _reader(tmp_path / "b")
    sources = merged.provenance["config"]["sources"]
    used = [sources[merged.metadata(i)["source"]] for i in range(9)]
    assert [source["config"]["eta"] for source in used] == [0.3] * 6 + [0.1] * 2 + [0.2]
    assert [source["seed"] for source in used] == [5] * 6 + [6] * 2 + [7]


def test_episodes_with_the_content_of_an_earlier_one_are_refused_or_dropped(
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
    assert json.loads(report.read_text())["dropped"] == 1


@pytest.mark.parametrize("duplicates", ["refuse", "drop"])
def test_equal_seed_and_number_of_another_configuration_are_another_episode(
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


def test_equal_scenarios_of_other_content_are_refused(
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


def test_controllers_do_not_mix(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write(tmp_path / "other", [6], Provenance("walk-2"))
    assert main(["merge", str(sound), str(other), f"--output_dir={tmp_path / 'new'}"]) == 3
    message = capsys.readouterr().err
    assert "walk-2" in message
    assert "stance-1" in message


def test_a_damaged_part_leaves_no_folder(sound: Path, copy: Path, tmp_path: Path) -> None:
    damage.flip_pixel(copy)
    more = write(tmp_path / "more", [6])
    assert main(["merge", str(more), str(copy), f"--output_dir={tmp_path / 'new'}"]) == 3
    assert {path.name for path in tmp_path.iterdir()} == {"copy", "more"}


@pytest.mark.parametrize("roots", [[], ["{sound}"]])
def test_one_dataset_is_not_enough(
    roots: list[str], sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [root.format(sound=sound) for root in roots]
    assert main(["merge", *flags, f"--output_dir={tmp_path / 'new'}"]) == 2
    assert "two datasets" in capsys.readouterr().err
