"""`egovcp-dataset` on datasets that LeRobot wrote: info, coverage, viz, repair, delete, split."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from egovcp.data import schema
from egovcp.data.stats import ROWS
from egovcp_collect.dataset.cli import main
from tests.support.lerobot_datasets import KINDS

from . import damage as d
from .test_others_damage import item, of_table, rows_of


def same_frames(root: Path, original: Path, episodes: list[int]) -> None:
    """LeRobot reads the same frames from ``root`` as from these episodes of the original."""
    found = LeRobotDataset("me/found", root=root, video_backend="pyav")
    expected = LeRobotDataset("me/theirs", root=original, video_backend="pyav")
    rows = [
        row
        for episode in episodes
        for row in range(
            expected.meta.episodes[episode]["dataset_from_index"],
            expected.meta.episodes[episode]["dataset_to_index"],
        )
    ]
    assert found.num_frames == len(rows)
    for number, row in enumerate(rows):
        frame, want = found[number], expected[row]
        for key in expected.features.keys() - {"index", "episode_index"}:
            np.testing.assert_array_equal(frame[key], want[key])
        assert (frame["index"], frame["task"]) == (number, want["task"])


@pytest.mark.parametrize("kind", KINDS)
def test_info_coverage_and_viz(
    kind: str, others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    features, lengths, tasks, _ = KINDS[kind]
    report, root = tmp_path / "report.json", str(others[kind])
    assert main(["info", root, f"--json={report}"]) == 0
    info = json.loads(report.read_text())
    assert (info["episodes"], info["frames"]) == (len(lengths), sum(lengths))
    assert set(info["tasks"]) == set(tasks)
    assert "not recorded: there is no meta/collection.json" in capsys.readouterr().out
    assert main(["coverage", root, f"--json={report}"]) == 0
    numbers = {key for key, f in features.items() if f["dtype"][:3] in ("flo", "int", "boo")}
    assert set(json.loads(report.read_text())["features"]) == numbers
    recording = tmp_path / "episode.rrd"
    assert main(["viz", root, "--episode=1", f"--output={recording}"]) == 0
    content = recording.read_bytes()
    for key, feature in features.items():
        assert (key.replace(".", "/").encode() in content) == (feature["dtype"] != "string")
    assert main(["viz", root, f"--episode={len(lengths)}"]) == 2


def test_coverage_names_constant_values(
    others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(others["arm"], tmp_path / "copy"))
    still = lambda values: values.__setitem__(slice(None), [[1.0, v[1]] for v in values])  # noqa: E731
    rows_of(d.DATA, action=still)(root)
    assert main(["coverage", str(root)]) == 0
    assert "action[0] (pan) is always 1: it carries no information" in capsys.readouterr().out


def test_coverage_refuses_a_value_that_is_not_finite(
    others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, report = Path(shutil.copytree(others["arm"], tmp_path / "copy")), tmp_path / "report.json"
    rows_of(d.DATA, observation_dot_state=item(9, [0.0, float("nan"), 0.0]))(root)
    assert main(["coverage", str(root), f"--json={report}"]) == 3
    message = f"{d.DATA}, episode 1, frame 1: observation.state[1] (lift) is nan"
    assert message in capsys.readouterr().err
    assert not report.exists()


@pytest.mark.parametrize(
    "kind",
    [
        kind if kind in ("arm", "cameras") else pytest.param(kind, marks=pytest.mark.slow)
        for kind in KINDS
    ],
)
def test_delete_and_split_keep_every_frame(
    kind: str, others: dict[str, Path], tmp_path: Path
) -> None:
    root, count = others[kind], len(KINDS[kind][1])
    assert main(["delete", str(root), "--episodes=[1]", f"--output_dir={tmp_path / 'less'}"]) == 0
    assert main(["check", str(tmp_path / "less")]) == 0
    same_frames(tmp_path / "less", root, [0, *range(2, count)])
    splits = "--splits={a: 0.6, b: 0.4}"
    assert main(["split", str(root), splits, f"--output_dir={tmp_path}"]) == 0
    sizes = [json.loads((tmp_path / n / d.INFO).read_text())["total_episodes"] for n in "ab"]
    assert sum(sizes) == count
    assert [main(["check", str(tmp_path / name)]) for name in "ab"] == [0, 0]


def test_own_datasets_are_split_with_their_records(sound: Path, tmp_path: Path) -> None:
    assert main(["delete", str(sound), "--episodes=[2]", f"--output_dir={tmp_path / 'a'}"]) == 0
    assert main(["split", str(sound), f"--output_dir={tmp_path / 'b'}"]) == 0
    for root in (tmp_path / "a", tmp_path / "b/train", tmp_path / "b/test"):
        assert (root / d.COLLECTION).is_file()
        assert main(["check", str(root)]) == 0


@pytest.mark.parametrize(
    "flags",
    [
        [],
        ["--episodes=[9]"],
        ["--episodes=0:4"],
        ["--splits={a: 0.9, b: 0.9}"],
        ["--splits={../a: 1}"],
        ["--splits={a: 0.9, b: 0.01}"],
    ],
)
def test_impossible_edits_are_refused(
    flags: list[str], others: dict[str, Path], tmp_path: Path
) -> None:
    command = "split" if any("splits" in flag for flag in flags) else "delete"
    output = tmp_path / "out"
    assert main([command, str(others["arm"]), *flags, f"--output_dir={output}"]) == 2
    assert not output.exists()


def test_split_writes_nothing_if_a_later_folder_is_in_use(sound: Path, tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine").touch()
    splits = ["split", str(sound), "--splits={a: 0.5, b: 0.5}", f"--output_dir={tmp_path}"]
    assert main(splits) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_plots_of_other_datasets_are_refused(
    others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["coverage", str(others["arm"]), f"--output_dir={tmp_path / 'plots'}"]) == 2
    assert "plots are of those only" in capsys.readouterr().err
    assert not (tmp_path / "plots").exists()


def test_a_gap_in_the_numbers_is_refused_and_repaired(
    others: dict[str, Path], tmp_path: Path
) -> None:
    root = Path(shutil.copytree(others["arm"], tmp_path / "copy"))
    of_table(episode_index=lambda v: v.__setitem__(3, 5))(root)
    rows_of(d.DATA, episode_index=lambda v: v.__setitem__(slice(27, 36), [5] * 9))(root)
    assert main(["delete", str(root), "--episodes=[2]", f"--output_dir={tmp_path / 'less'}"]) == 3
    assert not (tmp_path / "less").exists()
    assert main(["repair", str(root), f"--output_dir={tmp_path / 'new'}"]) == 0
    same_frames(tmp_path / "new", others["arm"], [0, 1, 2, 3])


def test_videos_are_not_read_to_find_listed_episodes(
    others: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("egovcp_collect.dataset.subset.frame_times")
    output = tmp_path / "less"
    assert main(["delete", str(others["arm"]), "--episodes=[1]", f"--output_dir={output}"]) == 0


@pytest.mark.parametrize(
    ("damage", "kept"),
    [
        (d.cut(d.EPISODES, 0.5), [0, 1, 2, 3]),
        (d.remove(d.TASKS), [0, 1, 2, 3]),
        (rows_of(d.DATA, timestamp=lambda v: v.__setitem__(12, 0.1)), [0, 2, 3]),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                (d.info(total_frames=3), [0, 1, 2, 3]),
                (d.statistic("action", "mean", [9.0, 9.0]), [0, 1, 2, 3]),
                (of_table(length=lambda v: v.__setitem__(1, 15)), [0, 1, 2, 3]),
                (rows_of(d.DATA, task_index=lambda v: v.__setitem__(12, 5)), [0, 2, 3]),
            )
        ),
    ],
)  # fmt: skip
def test_repair_keeps_what_is_sound(
    damage: d.Damage, kept: list[int], others: dict[str, Path], tmp_path: Path
) -> None:
    root, output = Path(shutil.copytree(others["arm"], tmp_path / "copy")), tmp_path / "new"
    damage(root)
    report = tmp_path / "report.json"
    assert main(["repair", str(root), f"--output_dir={output}", f"--json={report}"]) == 0
    dropped = {problem["episode"] for problem in json.loads(report.read_text())["dropped"]}
    assert dropped == set(range(4)) - set(kept)
    assert main(["check", str(output)]) == 0
    same_frames(output, others["arm"], kept)
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_repair_after_an_interrupted_recording(others: dict[str, Path], tmp_path: Path) -> None:
    """LeRobot issues 2529 and 3522: the last data file has no footer."""
    root, output = Path(shutil.copytree(others["chunks"], tmp_path / "copy")), tmp_path / "new"
    last = "data/chunk-002/file-000.parquet"
    d.cut(last, 0.8)(root)
    assert main(["repair", str(root), f"--output_dir={output}"]) == 0
    assert main(["check", str(output)]) == 0
    same_frames(output, others["chunks"], [0, 1, 2, 3])


@pytest.mark.parametrize("key", schema.INDEX_FEATURES)
def test_a_missing_index_feature_is_named(
    key: str, others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, output = Path(shutil.copytree(others["types"], tmp_path / "copy")), tmp_path / "new"
    d.edit(d.INFO, lambda info: info["features"].pop(key))(root)
    for command in (
        ["check", str(root)],
        ["repair", str(root), f"--output_dir={output}"],
        ["delete", str(root), "--episodes=[0]", f"--output_dir={output}"],
    ):
        assert main(command) == 3
        printed = capsys.readouterr()
        assert f"{d.INFO}: feature {key} is missing" in printed.out + printed.err
        assert not output.exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (d.edit(d.INFO, lambda i: i["features"].pop("timestamp")), "feature timestamp is missing"),
        (d.rows(lambda t: t.drop_columns(["timestamp"])), "episode 1: column timestamp is missing"),
        (d.rows(lambda t: t.drop_columns(["action"])), "episode 1: column action is missing"),
    ],
)
def test_viz_names_what_is_missing(
    damage: d.Damage, message: str, others: dict[str, Path], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    root, output = Path(shutil.copytree(others["types"], tmp_path / "copy")), tmp_path / "a.rrd"
    damage(root)
    assert main(["viz", str(root), "--episode=1", f"--output={output}"]) == 3
    assert message in capsys.readouterr().err
    assert not output.exists()


def test_lost_texts_of_tasks_are_named(
    others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, output = Path(shutil.copytree(others["types"], tmp_path / "copy")), tmp_path / "new"
    for name in (d.TASKS, "meta/episodes"):
        d.remove(name)(root)
    assert main(["repair", str(root), f"--output_dir={output}"]) == 3
    assert f"{d.DATA}, episode 2: no text of its task is known" in capsys.readouterr().out
    assert not output.exists()


def test_rows_without_task_index_are_named(
    others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(others["types"], tmp_path / "copy"))
    d.remove(d.TASKS)(root)
    d.rows(lambda table: table.drop_columns(["task_index"]))(root)
    assert main(["repair", str(root), f"--output_dir={tmp_path / 'new'}"]) == 3
    assert "no text of its task is known" in capsys.readouterr().out


def test_statistics_without_quantiles_are_kept(others: dict[str, Path], tmp_path: Path) -> None:
    """As of a dataset converted from v2.1; those of an episode that is not listed are computed."""
    root, output = Path(shutil.copytree(others["images"], tmp_path / "copy")), tmp_path / "new"

    def drop(table: pa.Table) -> pa.Table:
        quantiles = [n for n in table.column_names if n.rpartition("/")[2] in ROWS[4:]]
        return table.drop_columns(quantiles).slice(1)

    d.rows(drop, d.EPISODES)(root)
    before = pq.read_table(root / d.EPISODES)
    assert main(["repair", str(root), f"--output_dir={output}"]) == 0
    assert main(["check", str(output)]) == 0
    after = pq.read_table(output / d.EPISODES)
    assert len(after) == len(before) + 1
    mean = "stats/observation.image/mean"
    assert after[mean].to_pylist()[1:] == before[mean].to_pylist()
    assert "stats/observation.image/q01" not in after.column_names
    assert "stats/observation.state/q01" in after.column_names
    assert "q01" not in json.loads((output / d.STATS).read_text())["observation.image"]


def test_an_episode_in_two_files_is_named(
    others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, output = Path(shutil.copytree(others["types"], tmp_path / "copy")), tmp_path / "new"
    table = pq.read_table(root / d.DATA)  # episode 1 has rows 30 to 69
    pq.write_table(table.slice(0, 50), root / d.DATA)
    pq.write_table(table.slice(50), root / d.MORE_DATA)
    assert main(["delete", str(root), "--episodes=[0]", f"--output_dir={output}"]) == 3
    length = f"{d.DATA}, episode 1: meta/episodes gives it 40 frames, but it has 20"
    assert length in capsys.readouterr().err
    assert not output.exists()
    assert main(["repair", str(root), f"--output_dir={output}"]) == 0
    out = capsys.readouterr().out
    assert f"kept: {root / length}" in out
    assert f"{d.MORE_DATA}, episode 1: it has rows in another place" in out
    capsys.readouterr()
    assert main(["delete", str(root), "--episodes=[1]", f"--output_dir={tmp_path / 'less'}"]) == 0


def test_nothing_sound_leaves_no_dataset(others: dict[str, Path], tmp_path: Path) -> None:
    root, output = Path(shutil.copytree(others["arm"], tmp_path / "copy")), tmp_path / "new"
    d.feature("action", shape=[5], names=None)(root)
    assert main(["repair", str(root), f"--output_dir={output}"]) == 3
    assert not output.exists()
