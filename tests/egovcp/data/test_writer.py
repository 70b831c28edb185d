import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Episode, Provenance
from egovcp.data.writer import VersionWriter
from egovcp.errors import DataError, EnvironmentFailure, UsageError

_ARRAYS = ("depth", "state", "action", "reward", "done", "success", "truncated")


def _rewrite(reader: DatasetReader, root: Path, shard_episodes: int = 100) -> Path:
    with DatasetWriter(root, Provenance("stance-1", 0, "collect"), shard_episodes) as writer:
        for index in range(len(reader)):
            writer.add(reader.read(index))
    return root


def _files(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def test_write_read_write_is_the_identity(reader: DatasetReader, tmp_path: Path) -> None:
    assert _files(_rewrite(reader, tmp_path / "again")) == _files(reader.root)


def test_reading_returns_what_was_written(reader: DatasetReader, episodes: list[Episode]) -> None:
    assert len(reader) == len(episodes)
    assert reader.num_frames == sum(len(e) for e in episodes)
    for index, expected in enumerate(episodes):
        found = reader.read(index)
        for name in _ARRAYS:
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        assert (found.task, found.time_limit) == (expected.task, expected.time_limit)
        assert found.metadata == expected.metadata


def test_shards_have_the_given_size(reader: DatasetReader, tmp_path: Path) -> None:
    root = _rewrite(reader, tmp_path / "small-files", shard_episodes=2)
    assert len(list(root.glob("data/*/*.parquet"))) > 2
    rolled = DatasetReader.open(DatasetConfig(root=str(root)))
    for index in range(len(reader)):
        np.testing.assert_array_equal(rolled.read(index).depth, reader.read(index).depth)


def test_statistics_are_those_of_all_frames(reader: DatasetReader) -> None:
    state = reader.read_columns([spec.STATE_KEY])[spec.STATE_KEY].astype(np.float64)
    depth = reader.read_columns([spec.DEPTH_KEY])[spec.DEPTH_KEY].astype(np.float64)
    for key, values in ((spec.STATE_KEY, state), (spec.DEPTH_KEY, depth.reshape(-1, 1))):
        found = reader.stats[key]
        for name in ("min", "max", "mean", "std"):
            expected = getattr(values, name)(axis=0)
            np.testing.assert_allclose(np.ravel(found[name]), expected, rtol=1e-9, atol=1e-9)
        assert found["count"] == [reader.num_frames]


def test_depth_quantiles_are_exact_for_one_episode(tmp_path: Path, episodes: list[Episode]) -> None:
    with DatasetWriter(tmp_path / "one", Provenance("stance-1")) as writer:
        writer.add(episodes[0])
    stats = json.loads((tmp_path / "one/meta/stats.json").read_text())[spec.DEPTH_KEY]
    pixels = episodes[0].depth.astype(np.float64)
    for name, q in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        expected = np.quantile(pixels, q, method="lower")
        assert np.ravel(stats[name])[0] == pytest.approx(expected, abs=1.0)


def test_an_existing_folder_is_refused_and_untouched(tmp_path: Path) -> None:
    (tmp_path / "keep.txt").write_text("mine")
    with pytest.raises(UsageError, match="exists already"):
        DatasetWriter(tmp_path, Provenance("stance-1"))
    assert [p.name for p in tmp_path.iterdir()] == ["keep.txt"]


def _fail_after(root: Path, episode: Episode) -> None:
    with DatasetWriter(root, Provenance("stance-1")) as writer:
        writer.add(episode)
        raise RuntimeError("stop")


def test_a_failed_run_leaves_nothing(tmp_path: Path, episodes: list[Episode]) -> None:
    with pytest.raises(RuntimeError, match="stop"):
        _fail_after(tmp_path / "new", episodes[0])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [ModuleNotFoundError("No module named 'pandas'"), OSError(28)])
def test_a_failure_to_complete_the_files_leaves_nothing(
    tmp_path: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(self: VersionWriter) -> None:
        raise error

    monkeypatch.setattr(VersionWriter, "_write_tasks", fail)
    with pytest.raises(type(error)), DatasetWriter(tmp_path / "new", Provenance("s")) as writer:
        writer.add(episodes[0])
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_without_episodes_is_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(UsageError, match="no episode"),
        DatasetWriter(tmp_path / "new", Provenance("stance-1")),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_bad_episode_is_refused_with_its_frame(tmp_path: Path, make_episode: object) -> None:
    assert callable(make_episode)
    episode = make_episode(0)
    episode.state[5, 3] = np.nan
    with (
        pytest.raises(DataError, match="episode 0, frame 5: state is not finite"),
        DatasetWriter(tmp_path / "new", Provenance("stance-1")) as writer,
    ):
        writer.add(episode)
    assert list(tmp_path.iterdir()) == []


def test_the_folder_of_a_killed_writer_is_removed(tmp_path: Path, episodes: list[Episode]) -> None:
    code = """
import os, signal, sys
from egovcp.data import DatasetWriter, Provenance
from egovcp.testing import random_episode
with DatasetWriter(sys.argv[1], Provenance("stance-1")) as writer:
    writer.add(random_episode(0))
    os.kill(os.getpid(), signal.SIGKILL)
"""
    killed = subprocess.run([sys.executable, "-c", code, tmp_path / "new"], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    with DatasetWriter(tmp_path / "new", Provenance("stance-1")) as writer:
        writer.add(episodes[0])
    assert [p.name for p in tmp_path.iterdir()] == ["new"]


def test_a_second_writer_of_a_dataset_is_refused(tmp_path: Path, episodes: list[Episode]) -> None:
    with DatasetWriter(tmp_path / "new", Provenance("stance-1")) as writer:
        with (
            pytest.raises(EnvironmentFailure, match="new is being written by process"),
            DatasetWriter(tmp_path / "new", Provenance("stance-1")),
        ):
            pass
        writer.add(episodes[0])
    assert [p.name for p in tmp_path.iterdir()] == ["new"]
