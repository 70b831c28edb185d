import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader
from egovcp.data.committer import Committer
from egovcp.errors import DataError
from egovcp.sim.tasks import task_names
from egovcp_collect.collect import main
from egovcp_collect.config import CollectConfig
from egovcp_collect.worker_pool import WorkerPool

_SHORT = ["--env.ball_episode.ticks=6", "--env.ball_episode.event_ticks=[0,1]"]


def _collect(root: Path, *flags: str) -> int:
    return main([f"--dataset.root={root}", "--dataset.repo_id=me/ball", *_SHORT, *flags])


def _data(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in (root / "data").rglob("*.parquet")}


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("collect") / "ball"
    assert _collect(root, "--episodes=4", "--num_envs=2", "--num_workers=2", "--seed=3") == 0
    return root


def test_a_collection_is_a_valid_dataset(collected: Path) -> None:
    reader = DatasetReader.open(DatasetConfig(root=str(collected)))
    assert reader.lengths.tolist() == [6] * 4
    assert reader.controller_id
    for index in range(4):
        episode = reader.read(index)
        assert (episode.task, episode.time_limit) == ("ball", 6)
        assert episode.metadata["seed"] == 3
        assert episode.metadata["episode"] == index
        sums = [term["sum"] for term in episode.metadata["reward_terms"].values()]
        assert sum(sums) == pytest.approx(episode.reward.sum(), abs=1e-5)


def test_a_row_holds_the_observation_before_its_action(collected: Path) -> None:
    reader = DatasetReader.open(DatasetConfig(root=str(collected)))
    for index in range(4):
        episode = reader.read(index)
        command = episode.state[:, spec.COMMAND_SLICE][:, 3:]
        sent = np.concatenate([np.zeros((1, spec.ACTION_DIM)), episode.action[:-1]])
        np.testing.assert_allclose(command, spec.ACTION_BOX.to_metric(sent), atol=1e-5)
        steps = np.diff(episode.action, axis=0, prepend=0)
        assert np.abs(steps).max() <= spec.ACTION_ETA + 1e-6
        assert np.abs(steps).max() > 0.5 * spec.ACTION_ETA


def test_rows_hold_reward_terms_and_the_object(collected: Path) -> None:
    reader = DatasetReader.open(DatasetConfig(root=str(collected)))
    for index in range(4):
        episode = reader.read(index)
        np.testing.assert_allclose(episode.reward_terms.sum(1), episode.reward, atol=1e-5)
        assert (episode.reward_terms[:, spec.REWARD_TERMS.index("pose")] < 0).all()
        event, known = episode.metadata["event_tick"], episode.object[:, 3] > 0
        thrown = np.arange(6) > (6 if event is None else event)
        np.testing.assert_array_equal(known, thrown)  # the ball is thrown in the event's tick
        assert (episode.object[~known] == 0).all()
        ahead = episode.object[known, 0]
        assert (np.diff(ahead) < 0).all()  # it comes nearer
        assert ((ahead > 0.5) & (ahead < 3.5)).all()


def test_the_command_and_its_configuration_are_recorded(collected: Path) -> None:
    recorded = json.loads((collected / "meta/collection.json").read_text())
    assert recorded["seed"] == 3
    assert recorded["command"].startswith("egovcp-collect ")
    assert recorded["config"]["eta"] == 1.0
    assert recorded["config"]["env"]["ball_episode"]["ticks"] == 6
    assert recorded["versions"]["mujoco"]


def test_data_do_not_depend_on_the_number_of_workers(collected: Path, tmp_path: Path) -> None:
    assert _collect(tmp_path / "one", "--episodes=4", "--num_envs=3", "--num_workers=1",
                    "--seed=3") == 0  # fmt: skip
    assert _data(tmp_path / "one") == _data(collected)


def test_the_last_line_reports_episodes_steps_and_speed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _collect(tmp_path / "new", "--episodes=2", "--num_envs=2", "--num_workers=1") == 0
    last = capsys.readouterr().out.strip().splitlines()[-1]
    assert last.startswith("2 episodes, 12 steps, ")
    assert last.endswith(" steps/s")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--task=bal"], "did you mean 'ball'"),
        (["--task=sequence"], "only for evaluation"),
        (["--episodes=0"], "--episodes=0: expected at least 1"),
        (["--num_workers=-1"], "expected at least 0"),
        (["--seed=-1"], "expected at least 0"),
        (["--seed=1000000000"], "--seed=1000000000: expected a number from 0 to 999999999; the"),
        (["--eta=0.5", "--step_ticks=[1,1]"], "rate limit"),
        (["--eta=1", "--step_ticks=[3,9]"], "at most 0.96"),
        (["--step_ticks=[9,4]"], "shortest <= longest"),
        (["--boundary=bounce"], "bounce"),
        (["--task=ball,wall", "--mix={ball: 0, wall: 0}"], "weight above 0"),
        (
            ["--task=ball,wall", "--mix={arch: 2}"],
            "not a task of --task=ball,wall; expected one of ball, wall",
        ),
        (["--task=all", "--env.controller=stance"], "'stance' does not walk"),
        (["--task=arch", "--env.controller=stance"], "--env.controller=walk"),
        (["--episode=3"], "did you mean '--episodes'"),
        (["--dataset.revision=main"], "--dataset.revision"),
    ],
)
def test_invalid_options_are_usage_errors_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    assert _collect(tmp_path / "new", *flags) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert len(captured.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_refused(collected: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = _data(collected)
    assert _collect(collected, "--episodes=1") == 2
    assert "exists already" in capsys.readouterr().err
    assert _data(collected) == before


def test_a_destination_below_a_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    assert _collect(tmp_path / "file" / "new", "--episodes=1") == 2
    assert "below a file" in capsys.readouterr().err


def test_an_error_is_not_hidden_by_a_failed_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The simulation fails, then the commit of the staged episodes."""

    def fail(self: WorkerPool) -> None:
        raise DataError("the simulation failed")

    def full(self: Committer) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(WorkerPool, "poll", fail)
    monkeypatch.setattr(Committer, "commit", full)
    assert _collect(tmp_path / "new", "--episodes=1", "--num_workers=1") == 3
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1] == "egovcp-collect: error: the simulation failed"
    (warning,) = [line for line in lines if "warning" in line]
    assert "No space left" in warning


def test_a_damaged_staged_episode_is_a_data_error_and_no_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        WorkerPool,
        "poll",
        lambda pool, poll=WorkerPool.poll: [_damage_last(tmp_path, r) for r in poll(pool)],
    )
    assert _collect(tmp_path / "new", "--episodes=1", "--num_envs=1", "--num_workers=1") == 3
    err = capsys.readouterr().err
    assert "staged file of episode 0 was damaged" in err
    assert "--resume" in err


def _damage_last[R](folder: Path, report: R) -> R:
    for path in folder.glob(".new.collect/sealed/*.arrow"):
        path.write_bytes(b"damaged")
    return report


def test_episodes_of_a_diverging_simulation_are_not_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    heavy = [
        "--env.controller=stance",
        "--env.ball.radius_range=[0.01,0.01]",
        "--env.ball.mass_range=[10,10]",
        "--env.ball.flight_range=[0.2,0.2]",
        "--env.ball_episode.ticks=46",
        "--env.ball_episode.empty_probability=0",
    ]
    root = tmp_path / "new"
    code = _collect(root, *heavy, "--episodes=4", "--num_envs=4", "--num_workers=1")
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert code == 3, message
    assert "the simulation diverged in task ball, seed 0, episode" in message
    assert "radius=0.01, mass=10" in message
    with pytest.raises(DataError):
        DatasetReader.open(DatasetConfig(root=str(root)))


def test_ranges_that_cannot_be_simulated_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _collect(tmp_path / "new", "--env.ball.radius_range=[0.1,100]") == 2
    assert "at least 0.01 and at most 0.3" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_no_destination_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--episodes=1"]) == 2
    assert "--dataset.repo_id" in capsys.readouterr().err


@pytest.mark.parametrize(
    "mix", [{}, {"ball": 3.0, "arch": 0.0}, {"ball": 0.2, "wall": 0.5, "arch": 0.3}]
)
def test_every_prefix_has_the_shares_of_the_tasks(mix: dict[str, float]) -> None:
    """The shares are of the steps: the more steps an episode has, the fewer of them there are."""
    config = CollectConfig(task="all", mix=mix, episodes=300)
    tasks = [s.task for s in config.scenarios()]
    ticks = np.array([config.env.episode(task).ticks for task in task_names(training=True)])
    weights = np.array([mix.get(task, 1.0) for task in task_names(training=True)]) / ticks
    for length in range(1, 301):
        counts = np.array([tasks[:length].count(task) for task in task_names(training=True)])
        assert np.abs(counts - length * weights / weights.sum()).max() < 1.5
