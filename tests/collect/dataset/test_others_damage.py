"""Damage to datasets that LeRobot wrote: each kind is named with its file and episode."""

import itertools
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egovcp.checks.lerobot_dataset import lerobot_problems
from egovcp.data.lerobot import LeRobotReader
from egovcp.errors import DataError
from egovcp_collect.dataset.cli import main
from tests.support.lerobot_datasets import KINDS

from . import damage as d

TOP = "videos/observation.images.top/chunk-000/file-000.mp4"
LEFT = "videos/observation.images.left/chunk-000/file-001.mp4"


def of_table(**columns: Callable[[list[object]], object]) -> d.Damage:
    """Change columns of ``meta/episodes``; ``__`` in a name stands for a slash."""
    return rows_of(d.EPISODES, **columns)


def rows_of(name: str, **columns: Callable[[list[object]], object]) -> d.Damage:
    def damage(root: Path) -> None:
        table = pq.read_table(root / name)
        for key, change in columns.items():
            column = key.replace("__", "/").replace("_dot_", ".")
            values = table[column].to_pylist()
            change(values)
            at = table.column_names.index(column)
            field = table.schema.field(at)
            table = table.set_column(at, field, pa.array(values, field.type))
        pq.write_table(table, root / name)

    return damage


def item(at: int, value: object) -> Callable[[list[object]], object]:
    return lambda values: values.__setitem__(at, value)


def drop_row(root: Path) -> None:
    table = pq.read_table(root / d.DATA)
    keep = np.arange(len(table)) != 10
    pq.write_table(table.filter(keep), root / d.DATA)


def shorten_video(root: Path) -> None:
    """Encode 24 frames in place of 36."""
    import av

    with av.open(str(root / TOP), "w") as target:
        stream = target.add_stream("mpeg4", rate=10)
        stream.width, stream.height = 64, 48
        for _ in range(24):
            image = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8))
            target.mux(stream.encode(image))
        target.mux(stream.encode())


def add_feature(root: Path) -> None:
    won = {"dtype": "bool", "shape": [1], "names": None}
    d.edit(d.INFO, lambda info: info["features"].update({"next.won": won}))(root)


#: Kind of damage -> dataset, damage, and file, episode and a part of the text of a problem.
DAMAGE: dict[str, tuple[str, d.Damage, str, int | None, str]] = {
    "truncated data": ("chunks", d.cut(d.MORE_DATA, 0.7), d.MORE_DATA, 1, "interrupted before"),
    "truncated table": ("arm", d.cut(d.EPISODES, 0.7), d.EPISODES, None, "interrupted before"),
    "empty data file": ("chunks", d.cut(d.MORE_DATA, 0), d.MORE_DATA, 1, "interrupted before"),
    "missing data file": ("chunks", d.remove(d.MORE_DATA), d.MORE_DATA, 1, "missing"),
    "missing video": ("cameras", d.remove(LEFT), LEFT, 1, "missing"),
    "video too short": ("arm", shorten_video, TOP, 2, "3 of the episode's 7 frames are missing"),
    "truncated video": ("arm", d.cut(TOP, 0.5), TOP, 2, "7 of the episode's 7 frames are missing"),
    "damaged video": ("arm", d.replace(TOP, "no video"), TOP, 0, "the video is damaged"),
    "length in table": (
        "arm", of_table(length=item(1, 15)), d.DATA, 1, "gives it 15 frames, but it has 12",
    ),
    "episode twice": ("arm", of_table(episode_index=item(2, 1)), d.EPISODES, 1, "listed in row 2"),
    "rows of another episode": (
        "arm", rows_of(d.DATA, episode_index=lambda v: v.__setitem__(slice(8, 20), [0] * 12)),
        d.DATA, 1, "column episode_index is 0, expected 1",
    ),
    "null episode number": (
        "arm", rows_of(d.DATA, episode_index=item(9, None)), d.DATA, 1, "episode_index is null",
    ),
    "time goes back": (
        "arm", rows_of(d.DATA, timestamp=item(12, 0.1)), d.DATA, 1, "timestamps must increase",
    ),
    "time off the grid": (
        "arm", rows_of(d.DATA, timestamp=item(12, 0.43)), d.DATA, 1, "expected 0.4 at 10 fps",
    ),
    "missing row": ("arm", drop_row, d.DATA, 1, "frame_index is 3, expected 2"),
    "contradicting stats": (
        "arm", d.statistic("action", "mean", [7.0, 0.0]), d.STATS, None, "action[0] (pan) is 7",
    ),
    "contradicting episode stats": (
        "arm", of_table(stats__observation_dot_state__std=item(3, [9.0, 1.0, 1.0])),
        d.EPISODES, 3, "statistics of observation.state: std",
    ),
    "stats of images in 0 to 255": (
        "arm", d.statistic("observation.images.top", "mean", [[[120.0]], [[1.0]], [[1.0]]]),
        d.STATS, None, "lies in [0, 1]",
    ),
    "nan": (
        "arm", rows_of(d.DATA, observation_dot_state=item(9, [0.0, float("nan"), 0.0])),
        d.DATA, 1, "observation.state[1] (lift) is nan",
    ),
    "task without text": (
        "arm", rows_of(d.DATA, task_index=item(21, 7)), d.DATA, 2, "task_index 7 is not in",
    ),
    "task of the table": ("arm", of_table(tasks=item(1, ["fly"])), d.EPISODES, 1, "task 'fly'"),
    "shape": ("arm", d.feature("action", shape=[4], names=None), d.DATA, 0, "shape as [4]"),
    "dtype": ("types", d.feature("next.done", dtype="float32"), d.DATA, 0, "dtype is float32"),
    "column": ("types", add_feature, d.DATA, 0, "next.won"),
    "image": (
        "images", rows_of(d.DATA, observation_dot_image=item(6, {"bytes": b"x", "path": ""})),
        d.DATA, 1, "observation.image is not an image",
    ),
    "image size": (
        "images", d.feature("observation.image", shape=[3, 24, 24]), d.DATA, 0, "is 24x32, but",
    ),
    "video size": (
        "arm", d.feature("observation.images.top", shape=[40, 64, 3]), TOP, 0, "is 48x64",
    ),
    "video place": (
        "arm", of_table(videos__observation_dot_images_dot_top__from_timestamp=item(2, 2.03)),
        TOP, 2, "LeRobot raises FrameTimestampError",
    ),
    "total frames": ("arm", d.info(total_frames=99), d.INFO, None, "total_frames is 99"),
    "total episodes": ("arm", d.info(total_episodes=9), d.INFO, None, "total_episodes is 9"),
    "splits": ("arm", d.info(splits={"train": "0:9"}), d.INFO, None, "split train"),
    "old version": ("arm", d.info(codebase_version="v2.1"), d.INFO, None, "convert_dataset_v21"),
    "no tasks": ("arm", d.remove(d.TASKS), d.TASKS, None, "missing"),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_named(
    kind: str, others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, damage, file, episode, text = DAMAGE[kind]
    root = Path(shutil.copytree(others[name], tmp_path / "copy"))
    damage(root)
    report = tmp_path / "report.json"
    assert main(["check", str(root), f"--json={report}"]) == 3
    problems = json.loads(report.read_text())["problems"]
    matching = [p for p in problems if (p["file"], p["episode"]) == (file, episode)]
    assert any(text in problem["problem"] for problem in matching), problems
    assert text in capsys.readouterr().out


def test_what_is_not_checked_is_unknown_after_the_last_problem(
    others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(others["arm"], tmp_path / "copy"))
    d.info(total_frames=99, total_tasks=9)(root)
    report = tmp_path / "report.json"
    assert main(["check", str(root), f"--json={report}", "--max_problems=1"]) == 3
    assert json.loads(report.read_text())["not_checked"] is None
    assert "stopped after 1 problems; the rest was not checked" in capsys.readouterr().out
    assert main(["check", str(root), f"--json={report}"]) == 3
    assert json.loads(report.read_text())["not_checked"]
    assert "stopped" not in capsys.readouterr().out


def damage_row_group(
    path: Path, edges: Sequence[int], statistics: bool = True, key: str = "action"
) -> None:
    """Write row groups with these edges, and damage a column of the second."""
    table = pq.read_table(path)
    with pq.ParquetWriter(path, table.schema, write_statistics=statistics) as writer:
        for first, last in itertools.pairwise(edges):
            writer.write_table(table.slice(first, last - first))
    column = pq.read_metadata(path).row_group(1).column(table.column_names.index(key))
    content = bytearray(path.read_bytes())
    start = column.dictionary_page_offset or column.data_page_offset
    content[start : start + 8] = b"\xff" * 8
    path.write_bytes(content)


@pytest.mark.parametrize("statistics", [True, False])
def test_an_episode_is_read_beside_a_damaged_one(
    statistics: bool, others: dict[str, Path], tmp_path: Path
) -> None:
    root = Path(shutil.copytree(others["types"], tmp_path / "copy"))
    damage_row_group(root / d.DATA, (0, 30, 70, 72), statistics)
    reader = LeRobotReader.open(root)
    assert reader.read(reader.rows[2], ["action"]).num_rows == 2
    with pytest.raises(DataError, match="episode 1: damaged"):
        reader.read(reader.rows[1], ["action"])


@pytest.mark.parametrize("key", ["action", "episode_index"])
@pytest.mark.parametrize("edges", [(0, 30, 70, 72), (0, 30, 50, 72), (0, 40, 70, 72)])
def test_a_damaged_row_group_is_a_problem_of_its_episode_only(
    edges: Sequence[int], key: str, others: dict[str, Path], tmp_path: Path
) -> None:
    """Episode 1 has rows 30 to 69."""
    root = Path(shutil.copytree(others["types"], tmp_path / "copy"))
    damage_row_group(root / d.DATA, edges, key=key)
    (error,) = lerobot_problems(root)
    assert error.episode == 1
    assert "damaged" in error.problem


def rename(rows: list[object]) -> None:
    """Give all rows of episode 1 the number of another."""
    rows[:] = [3 if number == 1 else number for number in rows]


@pytest.mark.parametrize(
    ("damage", "episode", "frame", "text"),
    [
        (d.column("episode_index", d.put(35, 9)), 1, 5, "is 9, expected 1"),
        (d.column("episode_index", d.put(30, 0)), 1, 0, "is 0, expected 1"),
        (d.column("episode_index", d.put(69, 2)), 1, 39, "is 2, expected 1"),
        (d.column("episode_index", d.put(35, None)), 1, 5, "is null"),
        (d.column("episode_index", rename), 1, 0, "is 3, expected 1"),
        (d.rows(lambda table: table.drop_columns(["episode_index"])), 0, None, "lacks the column"),
        (of_table(episode_index=item(1, 0)), 0, None, "listed in row 1"),
        (of_table(episode_index=item(1, 2)), 2, None, "listed in row 1"),
        (of_table(episode_index=item(1, 9)), 9, None, "listed in row 1"),
        (of_table(episode_index=item(1, None)), None, None, "is null in row 1"),
        (
            d.rows(lambda table: table.drop_columns(["episode_index"]), d.EPISODES),
            None, None, "is missing",
        ),
    ],
)  # fmt: skip
def test_a_damaged_episode_index_is_one_problem(
    damage: d.Damage, episode: int | None, frame: int | None, text: str,
    others: dict[str, Path], tmp_path: Path,
) -> None:  # fmt: skip
    """Episode 1 has rows 30 to 69."""
    root = Path(shutil.copytree(others["types"], tmp_path / "copy"))
    damage(root)
    (error,) = lerobot_problems(root)
    assert (error.episode, error.frame) == (episode, frame)
    assert text in error.problem


def test_a_boundary_in_the_table_that_is_wrong_is_a_problem_of_the_table(
    others: dict[str, Path], tmp_path: Path
) -> None:
    """Episodes 0 and 1 have 30 and 40 frames."""
    root = Path(shutil.copytree(others["types"], tmp_path / "copy"))
    columns = {"dataset_to_index": item(0, 31), "dataset_from_index": item(1, 31)}
    of_table(**columns)(root)
    of_table(length=lambda values: values.__setitem__(slice(0, 2), [31, 39]))(root)
    problems = [error.problem for error in lerobot_problems(root)]
    assert [p for p in problems if "frame_index" in p or "timestamp" in p] == []
    assert any("gives it 31 frames, but it has 30" in problem for problem in problems)
    assert any("gives it 39 frames, but it has 40" in problem for problem in problems)


@pytest.mark.parametrize(
    ("damage", "problems"),
    [
        (d.rows(lambda table: table.drop_columns(["episode_index"])), 1),
        (d.swap(d.DATA, d.MORE_DATA), 2),
    ],
)
def test_a_damaged_file_is_no_problem_of_the_files_after_it(
    damage: d.Damage, problems: int, others: dict[str, Path], tmp_path: Path
) -> None:
    root = Path(shutil.copytree(others["chunks"], tmp_path / "copy"))
    damage(root)
    found = list(lerobot_problems(root))
    assert len(found) == problems
    assert {error.episode for error in found} <= {0, 1}


def test_statistics_of_booleans_may_be_booleans(others: dict[str, Path], tmp_path: Path) -> None:
    """As LeRobot 0.5 writes them, and 0.6 of episodes with a single frame."""
    root = Path(shutil.copytree(others["types"], tmp_path / "copy"))
    table = pq.read_table(root / d.EPISODES)
    for name in ("min", "max"):
        at = table.column_names.index(f"stats/next.done/{name}")
        values = [[bool(x) for x in row] for row in table.column(at).to_pylist()]
        table = table.set_column(at, table.column_names[at], pa.array(values))
    pq.write_table(table, root / d.EPISODES)
    d.statistic("next.done", "max", [True])(root)
    assert not list(lerobot_problems(root))


@pytest.mark.parametrize("kind", KINDS)
def test_an_undamaged_dataset_raises_no_alarm(
    kind: str, others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    assert main(["check", str(others[kind]), f"--json={report}"]) == 0
    result = json.loads(report.read_text())
    assert (result["ok"], result["episodes"]) == (True, len(KINDS[kind][1]))
    assert "how it was collected: there is no meta/collection.json" in result["not_checked"]
    assert capsys.readouterr().out.count("not checked: ") == len(result["not_checked"])
