import json
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from egovcp import spec
from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    Episode,
    Provenance,
    load_arrays,
    metadata,
    open_dataset,
)
from egovcp.data.committer import load_append_state
from egovcp.data.parquet import EPISODE_FEATURES
from egovcp.errors import DataError, UsageError
from egovcp.testing import random_episode
from tests.support.earlier import without_optional_columns

_DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture
def copy(dataset_root: Path, tmp_path: Path) -> Path:
    """A copy of the dataset that a test may damage."""
    return Path(shutil.copytree(dataset_root, tmp_path / "copy"))


def _read_all(root: Path) -> None:
    reader = DatasetReader.open(DatasetConfig(root=str(root)))
    for index in range(len(reader)):
        reader.read(index)


def _edit_json(name: str, edit: Callable[[dict], object]) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        content = json.loads((root / name).read_text())
        edit(content)
        (root / name).write_text(json.dumps(content))

    return damage


def _edit_info(edit: Callable[[dict], object]) -> Callable[[Path], None]:
    return _edit_json("meta/info.json", edit)


def _cut(name: str, keep: float) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        content = (root / name).read_bytes()
        (root / name).write_bytes(content[: int(keep * len(content))])

    return damage


def _edit_table(column: str, values: Callable[[list], list]) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        table = pq.read_table(root / _DATA)
        at = table.schema.get_field_index(column)
        field = table.schema.field(at)
        import pyarrow as pa

        new = pa.array(values(table[column].to_pylist()), field.type)
        pq.write_table(table.set_column(at, field, new), root / _DATA)

    return damage


def _nan_at_20(rows: list) -> list:
    rows[20] = float("nan")
    return rows


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: (r / "meta/info.json").unlink(), "no dataset at"),
        (lambda r: (r / "meta/tasks.parquet").unlink(), "tasks.parquet: missing"),
        (lambda r: (r / _DATA).unlink(), "file-000.parquet: missing"),
        (lambda r: (r / "meta/collection.json").unlink(), "controller .* unknown"),
        (lambda r: shutil.rmtree(r / "meta/episodes"), "holds no parquet file"),
        (_cut("meta/info.json", 0.5), "info.json: damaged"),
        (_cut("meta/episodes/chunk-000/file-000.parquet", 0.5), "file-000.parquet: damaged"),
        (_cut(_DATA, 0.9), "data/chunk-000/file-000.parquet.*: damaged"),
        (_edit_info(lambda i: i.update(fps=30)), "30 fps, expected 25"),
        (_edit_info(lambda i: i.update(codebase_version="v2.1")), "LeRobot format v2.1"),
        (_edit_info(lambda i: i.update(total_episodes=7)), "total_episodes is 7, but .* lists 6"),
        (_edit_info(lambda i: i.update(total_frames=7)), "total_frames is 7, but"),
        (_edit_info(lambda i: i.pop("features")), "lacks features"),
        (_edit_info(lambda i: i["features"].pop("action")), "feature action is missing"),
        (
            _edit_info(lambda i: i["features"]["action"].update(shape=[6])),
            r"action has shape \[6\], expected \[7\]",
        ),
        (
            _edit_info(lambda i: i["features"][spec.DEPTH_KEY]["info"].update(depth_unit="m")),
            "not a depth map in mm",
        ),
        (
            _edit_info(lambda i: i.update(data_path="../{chunk_index}/{file_index}.parquet")),
            "leads outside",
        ),
        (_edit_info(lambda i: i.update(data_path="/etc/{chunk_index}")), "leads outside"),
        (_edit_json("meta/collection.json", lambda c: c["episodes"].pop()), "records 5 episodes"),
        (_edit_json("meta/collection.json", lambda c: c.update(spec_version=0)), "specification 0"),
        (_edit_json("meta/collection.json", lambda c: c.update(controller_id="")), "no low-level"),
        (_edit_table("next.reward", _nan_at_20), "episode 2, frame 1: reward is not finite"),
        (
            _edit_table("timestamp", lambda rows: [2 * t for t in rows]),
            "frame 1: timestamp 0.08 s",
        ),
        (_edit_table("index", lambda rows: rows[::-1]), "column index is "),
        (
            _edit_table("task_index", lambda rows: [0] * len(rows)),
            "task is ball, .* wall",
        ),
    ],
)
def test_damage_is_refused_and_named(
    copy: Path, damage: Callable[[Path], object], message: str
) -> None:
    damage(copy)
    with pytest.raises(DataError, match=message):
        _read_all(copy)


def test_the_undamaged_copy_is_accepted(copy: Path) -> None:
    _read_all(copy)


def test_one_row_group_for_all_episodes_is_read(copy: Path, reader: DatasetReader) -> None:
    pq.write_table(pq.read_table(copy / _DATA), copy / _DATA)
    rewritten = DatasetReader.open(DatasetConfig(root=str(copy)))
    for index in range(len(reader)):
        np.testing.assert_array_equal(rewritten.read(index).depth, reader.read(index).depth)


def test_read_columns_concatenates_the_episodes(reader: DatasetReader) -> None:
    columns = reader.read_columns([spec.DEPTH_KEY, spec.ACTION_KEY, "frame_index"])
    read = [reader.read(i) for i in range(len(reader))]
    np.testing.assert_array_equal(columns[spec.DEPTH_KEY], np.concatenate([e.depth for e in read]))
    np.testing.assert_array_equal(
        columns[spec.ACTION_KEY], np.concatenate([e.action for e in read])
    )
    with pytest.raises(DataError, match="did you mean 'action'"):
        reader.read_columns(["actions"])


def test_reading_is_thread_safe(reader: DatasetReader) -> None:
    """As training does, which makes a batch ahead while held-out episodes are read."""
    names = tuple(EPISODE_FEATURES.values())
    expected = [reader.read_episode_columns(k, names) for k in range(len(reader))]
    asked = [k for _ in range(40) for k in range(len(reader))]
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda k: reader.read_episode_columns(k, names), asked))
    for k, columns in zip(asked, found, strict=True):
        assert all(np.array_equal(columns[name], expected[k][name]) for name in names)


def test_an_episode_out_of_range_is_an_index_error(reader: DatasetReader) -> None:
    for index in (-1, len(reader)):
        with pytest.raises(IndexError):
            reader.read(index)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (DatasetConfig(), "no dataset is named"),
        (DatasetConfig(repo_id="../../etc"), "not of the form user/name"),
        (DatasetConfig(repo_id="name"), "not of the form user/name"),
        (DatasetConfig(root="somewhere", revision="main"), "drop it"),
    ],
)
def test_a_config_that_names_no_dataset_is_a_usage_error(
    config: DatasetConfig, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        DatasetReader.open(config)


def test_load_arrays_pads_the_episodes(dataset_root: Path, episodes: list[Episode]) -> None:
    data = load_arrays(dataset_root)
    longest = max(map(len, episodes))
    assert data[spec.ACTION_KEY].shape == (len(episodes), longest, spec.ACTION_DIM)
    assert data[spec.DEPTH_KEY].shape == (len(episodes), longest, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    assert data[spec.REWARD_KEY].shape == (len(episodes), longest)
    for i, episode in enumerate(episodes):
        valid = data["valid"][i]
        assert valid.sum() == len(episode)
        np.testing.assert_array_equal(data[spec.DEPTH_KEY][i, valid], episode.depth)
        np.testing.assert_array_equal(data[spec.STATE_KEY][i, valid], episode.state)
        assert not data[spec.STATE_KEY][i, ~valid].any()


def test_load_arrays_reads_some_columns(reader: DatasetReader) -> None:
    data = load_arrays(reader, ["action", "next.done"])
    assert set(data) == {"action", "next.done", "valid"}
    assert data["next.done"].dtype == np.bool_


def test_open_dataset_iterates_over_episodes(dataset_root: Path, episodes: list[Episode]) -> None:
    digests = [episode.digest() for episode in open_dataset(str(dataset_root))]
    assert digests == [episode.digest() for episode in episodes]


def test_unknown_columns_and_folders_are_data_errors(dataset_root: Path) -> None:
    with pytest.raises(DataError, match="did you mean 'action'"):
        load_arrays(dataset_root, ["actions"])
    with pytest.raises(DataError, match=r"no such folder: .*nowhere/at/all"):
        open_dataset("nowhere/at/all")


def test_a_dataset_of_an_earlier_version_has_zeros(copy: Path, episodes: list[Episode]) -> None:
    absent = list(spec.OPTIONAL_KEYS)
    without_optional_columns(copy)
    reader = DatasetReader.open(DatasetConfig(root=str(copy)))
    assert not set(absent) & set(reader.features)
    columns = reader.read_columns([*absent, spec.REWARD_KEY])
    assert not any(columns[key].any() for key in absent)
    np.testing.assert_array_equal(
        columns[spec.REWARD_KEY], np.concatenate([e.reward for e in episodes])
    )
    assert not reader.to_episode(
        0, reader.read_episode_columns(0, [*EPISODE_FEATURES.values()])
    ).object.any()
    with pytest.raises(DataError, match="was written by an earlier version"):
        load_append_state(copy)


def test_a_dataset_that_is_replaced_while_it_is_opened_is_opened_again(
    copy: Path, tmp_path: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> None:
    longer = tmp_path / "longer"
    with DatasetWriter(longer, Provenance("stance-1", seed=0, command="collect")) as writer:
        for episode in [*episodes, random_episode(6)]:
            writer.add(episode)
    load = metadata.load_episode_table

    def load_and_replace(root: Path, info: Mapping[str, Any]) -> metadata.EpisodeTable:
        table = load(root, info)
        if longer.exists():
            shutil.rmtree(copy)
            longer.rename(copy)
        return table

    monkeypatch.setattr(metadata, "load_episode_table", load_and_replace)
    assert len(open_dataset(copy)) == 7


@pytest.mark.parametrize("name", ["task", None])
def test_the_index_of_the_tasks_need_not_have_a_name(name: str | None, tmp_path: Path) -> None:
    """LeRobot 0.4 and its conversion of v2.1 datasets give it none."""
    (tmp_path / "meta").mkdir()
    frame = pd.DataFrame({"task_index": [0, 1]}, index=pd.Index(["ball", "wall"], name=name))
    frame.to_parquet(tmp_path / "meta/tasks.parquet")
    assert metadata.load_tasks(tmp_path) == {0: "ball", 1: "wall"}
