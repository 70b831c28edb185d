"""The probe sees the row that it explains, and knows nothing that it should not."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import reachable
from probe import Data, ProbeConfig, explained, probe
from probe_inputs import blocks, mirrored
from reachable import Episodes
from true_state import Columns, true_states

from egovcp import spec
from egovcp.cli import DatasetConfig
from egovcp.data import DatasetReader, ReturnConfig
from egovcp.errors import DataError
from egovcp_collect import collect
from egovcp_train import train
from egovcp_train.heldout import command

TASK_FLAGS = {
    task: [f"--env.{task}_episode.ticks=26", f"--env.{task}_episode.event_ticks=[1,6]"]
    for task in spec.TASKS
}
EPISODES = 5  # of each task
NOISE = 8 * 0.002  # rad, of a joint's measured position


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some episodes of every task."""
    folder = tmp_path_factory.mktemp("reachable") / "all"
    flags = [flag for of_task in TASK_FLAGS.values() for flag in of_task]
    arguments = ["--task=all", f"--episodes={3 * EPISODES}", "--num_workers=1", "--seed=3"]
    assert collect.main([f"--dataset.root={folder}", *arguments, *flags]) == 0
    return folder


@pytest.fixture(scope="module")
def reader(root: Path) -> DatasetReader:
    return DatasetReader.open(DatasetConfig(root=str(root)))


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kept")


@pytest.fixture(scope="module")
def columns(reader: DatasetReader, kept: Path) -> Columns:
    """True states of the whole dataset."""
    return true_states(reader, range(len(reader)), kept)


def test_truth_is_that_of_the_recorded_row(columns: Columns, reader: DatasetReader) -> None:
    recorded = reader.read_columns([spec.STATE_KEY, spec.ACTION_KEY, spec.REWARD_KEY])
    assert np.array_equal(columns["action"], recorded[spec.ACTION_KEY])
    assert np.array_equal(columns["reward"][:, 0], recorded[spec.REWARD_KEY])
    state = recorded[spec.STATE_KEY]
    measured = state[:, spec.STATE_SLICES["joint_position"]]
    wrong = abs(columns["joint_position"] - measured).max(axis=1)
    late = abs(columns["joint_position"][1:] - measured[:-1]).max(axis=1)
    assert wrong.max() < NOISE < np.quantile(late, 0.9)
    own_clock = np.concatenate([np.arange(n) for n in reader.lengths]) * spec.PLANNER_DT
    assert np.allclose(columns["time"][:, 0], own_clock)


def test_what_was_simulated_is_kept(
    columns: Columns, reader: DatasetReader, kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("true_state.resimulate", None)
    again = true_states(reader, range(len(reader)), kept)
    assert all(np.array_equal(again[name], column) for name, column in columns.items())


def test_an_episode_that_comes_out_otherwise_is_refused(
    reader: DatasetReader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = DatasetReader.read_episode_columns

    def changed(self: DatasetReader, index: int, names: tuple[str, ...]) -> object:
        found = honest(self, index, names)
        return found | {spec.REWARD_KEY: found[spec.REWARD_KEY] + np.float32(index == 1)}

    monkeypatch.setattr(DatasetReader, "read_episode_columns", changed)
    with pytest.raises(DataError, match=r"1 of 2 episodes come out otherwise.*first is 1"):
        true_states(reader, [0, 1], tmp_path)


@pytest.mark.parametrize("task", spec.TASKS)
def test_no_input_tells_the_event_to_come(
    task: str, columns: Columns, reader: DatasetReader
) -> None:
    of_task = np.repeat([reader.task(i) == task for i in range(len(reader))], reader.lengths)
    before = of_task & (columns["since_event"][:, 0] <= 0)
    rows = {name: column[before] for name, column in columns.items()}
    other = rows | {"since_event": np.full_like(rows["since_event"], -1.0)}
    known, unknown = blocks(task, rows), blocks(task, other)
    assert len(rows["time"]) > 0
    assert all(np.array_equal(known[name], unknown[name]) for name in known)


def test_twice_mirrored_is_the_same_and_once_is_not(columns: Columns) -> None:
    once = mirrored(columns)
    twice = mirrored(once)
    assert all(np.array_equal(twice[name], column) for name, column in columns.items())
    left, right = columns["hands_b"][:, :3], columns["hands_b"][:, 3:]
    assert np.array_equal(once["hands_b"][:, :3], right * np.float32([1, -1, 1]))
    assert not np.array_equal(once["hands_b"][:, :3], left)


def _thirds(told: np.ndarray, target: np.ndarray) -> list[Data]:
    order = np.random.default_rng(0).permutation(len(target))
    return [Data({"told": told[rows]}, target[rows]) for rows in np.array_split(order, 3)]


@pytest.mark.parametrize("shuffled", [False, True])
def test_probe_finds_a_return_that_it_is_told_and_none_in_shuffled_rows(
    shuffled: bool, columns: Columns, reader: DatasetReader
) -> None:
    length, limits = reader.lengths, tuple(reader.time_limit(i) for i in range(len(reader)))
    episodes = Episodes(columns, length, limits, ("",) * len(length))
    target, _ = episodes.returns(ReturnConfig(steps=8))
    told = np.tile(target[:, None], 3)
    if shuffled:
        told = np.random.default_rng(1).permutation(told)
    config = ProbeConfig(steps=300, rows=128, hidden=(32,), check_every=10, average=1, dropout=0.0)
    fit, validation, judged = _thirds(told, target)
    r2 = explained(probe(fit, validation, judged, config).value, judged.target)
    assert -0.5 < r2 < 0.1 if shuffled else r2 > 0.9


@pytest.fixture(scope="module")
def policy(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny artifact, hardly trained."""
    run = tmp_path_factory.mktemp("policy") / "run"
    quick = "--preset=debug --steps=30 --batch_size=2 --sampling.length=6 --returns.steps=8"
    calm = "--eval_freq=0 --tensorboard=false --threads=1 --device=cpu"
    flags = [*quick.split(), *calm.split()]
    assert train.main([f"--dataset.root={root}", f"--output_dir={run}", *flags]) == 0
    return run / "checkpoints" / "last" / "pretrained_model"


def test_q_is_judged_on_the_rows_on_which_every_other_measure_judges_it(
    root: Path, policy: Path, kept: Path, tmp_path: Path
) -> None:
    own, other = tmp_path / "own.json", tmp_path / "other"
    common = [f"--dataset.root={root}", f"--policy.path={policy}", "--threads=1"]
    quick = ["--probe.steps=20", "--probe.check_every=10", "--probe.hidden=[8]"]
    assert reachable.main([*common, f"--output_dir={kept}", f"--json={own}", *quick]) == 0
    flags = ["--episodes=0", "--pictures=false", "--device=cpu", f"--output_dir={other}"]
    assert command.main([*common, *flags]) == 0
    found = json.loads(own.read_text())
    expected = json.loads((other / "heldout.json").read_text())["tasks"]
    assert expected
    for task, report in expected.items():
        for name, value in report["value"].items():
            assert found[f"{task}_q_{name}"] == pytest.approx(value, rel=1e-4, abs=1e-6)
        assert found[f"{task}_reachable_rows"] == report["value"]["rows"]


def test_a_policy_of_another_controller_is_refused(
    root: Path, policy: Path, kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Path(shutil.copytree(root, tmp_path / "copy"))
    (other / "meta" / "sha256.json").unlink()
    collection = other / "meta" / "collection.json"
    collection.write_text(
        json.dumps(json.loads(collection.read_text()) | {"controller_id": "another"})
    )
    flags = [f"--dataset.root={other}", f"--policy.path={policy}", f"--output_dir={kept}"]
    assert reachable.main(flags) == 4
    assert "another" in capsys.readouterr().err
