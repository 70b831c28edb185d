"""egovcp-train on several datasets, in memory and from the disk; what it refuses."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from egovcp.artifact import load_artifact
from egovcp.data import DatasetWriter, Provenance
from egovcp.robot_spec import G1
from egovcp.testing import random_episode
from egovcp_train.checkpoint import load_training_state
from egovcp_train.train import main
from tests.support.arguments import Arguments


@pytest.fixture
def mixed(arguments: Arguments, dataset_root: Path, tmp_path: Path) -> Arguments:
    """Flags of a run on the dataset and a copy of it."""
    copy = shutil.copytree(dataset_root, tmp_path / "copy")

    def build(output: Path, *flags: str, weights: tuple[str, str] = ("2", "1")) -> list[str]:
        roots = zip((dataset_root, copy), weights, strict=True)
        given = ", ".join(f"{{root: {root}, weight: {weight}}}" for root, weight in roots)
        return [*arguments(output, dataset__root=None), f"--datasets=[{given}]", *flags]

    return build


def test_a_resumed_run_on_two_datasets_continues_the_stream(
    mixed: Arguments, tmp_path: Path
) -> None:
    straight, resumed = tmp_path / "straight", tmp_path / "resumed"
    assert main(mixed(straight, "--sampling.tasks={ball: 2}")) == 0
    assert main(mixed(resumed, "--sampling.tasks={ball: 2}", "--steps=3")) == 0
    assert main([f"--output_dir={resumed}", "--resume", "--steps=6"]) == 0
    one, two = load_training_state(straight), load_training_state(resumed)
    assert one["stream"] == two["stream"]
    assert one["stream"]["mix"] == {"datasets": [2.0, 1.0], "tasks": {"ball": 2.0}}
    artifact = load_artifact(str(straight / "checkpoints" / "last" / "pretrained_model"))
    assert len(artifact.manifest["datasets"]) == 2
    assert all(torch.isfinite(w).all() for w in two["learner"]["model"].values())


@pytest.mark.parametrize(
    ("weights", "flags", "message"),
    [
        (("1", "null"), [], "every dataset a weight, or none"),
        (("1", "-1"), [], "--datasets[1].weight=-1.0: expected at least 0"),
        (("1", "1"), ["--sampling.tasks={bal: 2}"], "did you mean 'ball'"),
        (("1", "1"), ["--dataset.root=x"], "--dataset and --datasets"),
        (("1", "1"), ["--returns.steps=0"], "--returns.steps=0"),
    ],
)
def test_invalid_mixtures_are_refused_before_output_is_written(
    mixed: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    weights: tuple[str, str],
    flags: list[str],
    message: str,
) -> None:
    assert main(mixed(tmp_path / "run", *flags, weights=weights)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("mode", ["ram", "stream"])
def test_dataset_without_a_complete_return_beside_others_is_refused(
    mixed: Arguments, tmp_path: Path, mode: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Returns over 5 steps, in episodes of 4 rows that end at their time limit."""
    short = tmp_path / "short"
    with DatasetWriter(short, Provenance("stance-test", seed=1)) as writer:
        for number in range(3):
            writer.add(random_episode(number, 4, seed=1))
    argv = [flag.replace(str(tmp_path / "copy"), str(short)) for flag in mixed(tmp_path / "run")]
    assert main([*argv, f"--loading.mode={mode}"]) == 3
    message = capsys.readouterr().err.splitlines()[-1]
    assert f"{short}: no row has a complete Monte Carlo return" in message
    assert "--returns.steps" in message
    assert not (tmp_path / "run").exists()


# --- from the disk ----------------------------------------------------------------------------
def test_a_resumed_run_from_the_disk_continues_the_stream(
    arguments: Arguments, tmp_path: Path
) -> None:
    def argv(name: str, **options: object) -> list[str]:
        window = {"loading__mode": "stream", "loading__shuffle__episodes": 3}
        return arguments(tmp_path / name, **window, **options)

    assert main(argv("straight", steps=8)) == 0
    assert main(argv("resumed", steps=4)) == 0
    for steps in (6, 8):
        flags = [f"--output_dir={tmp_path / 'resumed'}", "--resume", f"--steps={steps}"]
        assert main(flags) == 0
    one, two = (load_training_state(tmp_path / name) for name in ("straight", "resumed"))
    assert one["stream"] == two["stream"]


def test_the_statistics_from_the_disk_are_those_from_memory(
    arguments: Arguments, tmp_path: Path
) -> None:
    models = []
    for mode in ("ram", "stream"):
        argv = arguments(tmp_path / mode, steps=1, loading__mode=mode, seed=3)
        assert main(argv) == 0
        folder = tmp_path / mode / "checkpoints" / "last" / "pretrained_model"
        models.append(load_artifact(str(folder)).world_model.state_dict())
    for name in ("state_mean", "state_std", "return_mean", "return_std", "min_return"):
        torch.testing.assert_close(models[0][name], models[1][name])


@pytest.mark.parametrize(("available", "mode"), [(10**12, "ram"), (10**5, "stream")])
def test_auto_mode_is_recorded_and_kept_on_resume(
    arguments: Arguments,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    available: int,
    mode: str,
) -> None:
    monkeypatch.setattr("egovcp_train.datasets.available_bytes", lambda: available)
    assert main(arguments(tmp_path / "run", steps=1)) == 0
    monkeypatch.undo()
    saved = (tmp_path / "run" / "train_config.yaml").read_text(encoding="utf-8")
    assert f"mode: {mode}" in saved
    assert main([f"--output_dir={tmp_path / 'run'}", "--resume", "--steps=2"]) == 0


def test_memory_is_estimated_from_the_frames_of_the_robot(
    arguments: Arguments,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """60 kB each, nine times those of the G1."""
    root, robot = tmp_path / "arm", replace(G1, robot_type="arm", depth=(144, 208))
    with DatasetWriter(root, Provenance("stance-test", seed=1)) as writer:
        for number in range(3):
            writer.add(random_episode(number, 8, seed=1, robot=robot))
    argv = arguments(tmp_path / "run", dataset__root=root, steps=1)
    with monkeypatch.context() as patch:
        patch.setattr("egovcp.hardware.available_bytes", lambda: 10**6)
        assert main(argv) == 2
    assert "--batch_size=2 with --sampling.length=6 takes at least" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    monkeypatch.setattr("egovcp_train.datasets.available_bytes", lambda: 10**6)
    assert main(argv) == 0
    assert "mode: stream" in (tmp_path / "run" / "train_config.yaml").read_text(encoding="utf-8")


# --- faults -----------------------------------------------------------------------------------
def _rewritten(root: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Change the data and remove the recorded hashes."""
    (path,) = (root / "data").rglob("*.parquet")
    pq.write_table(change(pq.read_table(path)), path)
    collection = root / "meta" / "collection.json"
    facts = json.loads(collection.read_text(encoding="utf-8"))
    for episode in facts["episodes"]:
        episode.pop("sha256")
    collection.write_text(json.dumps(facts), encoding="utf-8")
    (root / "meta" / "sha256.json").unlink()


def _not_a_number(table: pa.Table) -> pa.Table:
    reward = table["next.reward"].to_numpy().copy()
    reward[100] = np.nan
    at = table.column_names.index("next.reward")
    return table.set_column(at, table.schema.field(at), pa.array(reward, pa.float32()))


def _other_spec(root: Path) -> None:
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text(encoding="utf-8"))
    info["features"]["action"]["shape"] = [6]
    path.write_text(json.dumps(info), encoding="utf-8")


@pytest.mark.parametrize("mode", ["ram", "stream"])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: _rewritten(root, _not_a_number), "reward is not finite"),
        (lambda root: _rewritten(root, lambda t: t.drop_columns("action")), "action"),
        (_other_spec, "action"),
        (lambda root: (root / "meta" / "collection.json").unlink(), "collection.json"),
    ],
    ids=["not a number", "missing feature", "wrong shape", "foreign dataset"],
)
def test_bad_data_is_refused_before_training_starts(
    arguments: Arguments,
    dataset_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mode: str,
    damage: Callable[[Path], None],
    message: str,
) -> None:
    bad = shutil.copytree(dataset_root, tmp_path / "bad")
    damage(bad)
    argv = arguments(tmp_path / "run", dataset__root=bad, loading__mode=mode)
    assert main(argv) == 3
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("egovcp-train: error: ")
    assert str(bad) in error
    assert message in error
    assert not (tmp_path / "run").exists()
