"""What can be read is kept, what cannot is named, and the damaged dataset is left alone."""

import hashlib
import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader
from egovcp_collect.dataset.cli import main

from . import damage as d
from .damage import COLLECTION, DATA, EPISODES, INFO, MORE_DATA, STATS, TASKS

pytestmark = pytest.mark.usefixtures("no_network")


def _digests(root: Path) -> list[str]:
    reader = DatasetReader.open(DatasetConfig(root=str(root)))
    return [reader.read(i).digest() for i in range(len(reader))]


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
        (d.remove(STATS), [0, 1, 2, 3, 4, 5], []),
        (d.remove(TASKS), [0, 1, 2, 3, 4, 5], []),
        (d.remove("meta/episodes"), [0, 1, 2, 3, 4, 5], []),
        (d.cut(EPISODES, 0.5), [0, 1, 2, 3, 4, 5], []),
        (d.info(data_path="../{chunk_index}"), [0, 1, 2, 3, 4, 5], []),
        (d.cut(DATA, 0.5), [3, 4, 5], [(DATA, 0), (DATA, 1), (DATA, 2)]),
        (d.remove(MORE_DATA), [0, 1, 2], [(MORE_DATA, 3), (MORE_DATA, 4), (MORE_DATA, 5)]),
        (d.swap(DATA, MORE_DATA), [3, 4, 5, 0, 1, 2], []),
        (d.flip_pixel, [0, 2, 3, 4, 5], [(DATA, 1)]),
        (d.column("next.reward", d.put(14, float("nan"))), [0, 2, 3, 4, 5], [(DATA, 1)]),
        (d.column("timestamp", d.put(14, 9.0)), [0, 2, 3, 4, 5], [(DATA, 1)]),
        (d.column("episode_index", d.put(30, 7)), [0, 1, 3, 4, 5], [(DATA, 2), (DATA, 7)]),
        (d.column(spec.DEPTH_KEY, d.blob(14, lambda b: None)), [0, 2, 3, 4, 5], [(DATA, 1)]),
        (d.record(1, sha256="0" * 64), [0, 2, 3, 4, 5], [(DATA, 1)]),
        (d.record(1, task="juggle"), [0, 2, 3, 4, 5], [(DATA, 1)]),
        (d.outside(DATA), [3, 4, 5], [(DATA, 0), (DATA, 1), (DATA, 2)]),
    ],
)
def test_every_sound_episode_is_kept_and_the_others_named(
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


def test_row_groups_of_any_size_are_read(sound: Path, copy: Path, tmp_path: Path) -> None:
    table = pq.read_table(copy / DATA)
    pq.write_table(table, copy / DATA, row_group_size=5)
    assert main(["repair", str(copy), f"--output_dir={tmp_path / 'new'}"]) == 0
    assert _digests(tmp_path / "new") == _digests(sound)


def test_nothing_readable_is_exit_code_3_and_leaves_no_folder(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(copy / "data")
    new = tmp_path / "new"
    assert main(["repair", str(copy), f"--output_dir={new}"]) == 3
    assert "nothing of" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


@pytest.mark.parametrize("damage", [d.remove(COLLECTION), d.cut(COLLECTION, 0.5)])
def test_without_records_the_originals_are_asked_for(
    damage: d.Damage, sound: Path, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(copy)
    new = tmp_path / "new"
    assert main(["repair", str(copy), f"--output_dir={new}"]) == 3
    assert "--records=ORIGINAL" in capsys.readouterr().err
    assert main(["repair", str(copy), f"--output_dir={new}", f"--records={sound}"]) == 0
    assert _digests(new) == _digests(sound)


def test_the_reader_names_the_command_that_helps(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
def test_a_bad_destination_is_a_usage_error(
    flags: list[str], message: str, sound: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _content(copy)
    flags = [flag.format(copy=copy, sound=sound) for flag in flags]
    assert main(["repair", str(copy), *flags]) == 2
    assert message in capsys.readouterr().err
    assert _content(copy) == before
