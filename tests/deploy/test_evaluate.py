"""`egovcp-eval`: same scenarios for all, reproducible, documented keys, clear refusals."""

from __future__ import annotations

import itertools
import json
import signal
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from egovcp.artifact import load_artifact
from egovcp.errors import SimulationDiverged
from egovcp.plan.backends import library
from egovcp.policy_options import PolicyOptions
from egovcp.robot.stance import StanceController
from egovcp.sim import robot
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM
from egovcp_deploy import episodes
from egovcp_deploy.controllers import ReferencePolicy, reference
from egovcp_deploy.deploy import main as deploy
from egovcp_deploy.episodes import EpisodeGroup, EpisodePool
from egovcp_deploy.evaluate import EvalConfig, main
from egovcp_deploy.scores import EpisodeScore
from tests.support.models import toy_reactive

KEYS = {
    "episodes",
    "success_rate",
    "success_ci95",
    "reward_mean",
    "reward_ci95",
    "plan_ms_p50",
    "plan_ms_p99",
}


def run(out: Path, *flags: str) -> int:
    return main([f"--output_dir={out}", "--num_workers=1", *flags])


def played(out: Path) -> Any:
    return json.loads((out / "eval_run.json").read_text())["episodes"]


@pytest.fixture(scope="module")
def config() -> EnvConfig:
    """Short ball episodes."""
    brief = EpisodeConfig(ticks=60, event_ticks=(50, 50), empty_probability=0.0)
    return EnvConfig(controller="stance", ball_episode=brief)


@pytest.fixture
def constant_file(tmp_path: Path) -> Path:
    best = {"action": [0.2] * ACTION_DIM, "reward_mean": 0.0, "success_rate": 0.5, "episodes": 9}
    path = tmp_path / "constant.json"
    path.write_text(json.dumps({"constants": {"ball": best}}))
    return path


def test_all_controllers_play_the_same_scenarios(
    tmp_path: Path,
    artifact_dir: Path,
    short: list[str],
    constant_file: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    code = run(
        out,
        f"--policy.path={artifact_dir}",
        "--episodes=3",
        "--num_envs=2",
        f"--constant.path={constant_file}",
        *short,
    )
    captured = capsys.readouterr()
    assert code == 0, captured.err
    backend = json.loads((out / "eval_run.json").read_text())["backend"]
    assert f"plans computed by {backend}" in captured.out
    figures = json.loads((out / "eval.json").read_text())
    assert set(figures) == {"ball"}
    assert set(figures["ball"]) == {"planner", "hold", "constant", "random", "oracle"}
    for row in figures["ball"].values():
        assert set(row) == KEYS
        assert row["episodes"] == 3
        assert row["success_ci95"][0] <= row["success_rate"] <= row["success_ci95"][1]
        assert row["reward_ci95"][0] <= row["reward_mean"] <= row["reward_ci95"][1]
    for scores in played(out)["ball"].values():
        assert [score["episode"] for score in scores] == [0, 1, 2]
        for score in scores:
            assert sum(score["terms"].values()) == pytest.approx(score["reward"])
    assert captured.out.count("ball") >= 5
    assert "eval.json" in captured.out


def test_constants_are_reused_with_the_same_controller_and_environment_only(
    tmp_path: Path,
    constant_file: Path,
    short: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    flags = ["--controllers=constant", "--episodes=1", *short]
    assert run(tmp_path / "old", f"--constant.path={constant_file}", *flags) == 0
    written = tmp_path / "old" / "constant.json"
    assert run(tmp_path / "same", f"--constant.path={written}", *flags) == 0
    assert played(tmp_path / "same") == played(tmp_path / "old")
    longer = [*flags, "--env.ball_episode.ticks=16"]
    assert run(tmp_path / "longer", f"--constant.path={written}", *longer) == 2
    assert "env.ball_episode.ticks=15, expected 16" in capsys.readouterr().err
    content = json.loads(written.read_text())
    written.write_text(json.dumps(content | {"low_level_controller": "another"}))
    assert run(tmp_path / "other", f"--constant.path={written}", *flags) == 2
    assert "low_level_controller=another" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_results_do_not_depend_on_how_episodes_are_grouped(
    tmp_path: Path, artifact_dir: Path, short: list[str]
) -> None:
    flags = [
        f"--policy.path={artifact_dir}",
        "--controllers=random,planner,oracle",
        "--episodes=4",
        *short,
    ]
    for size in (1, 3):
        assert run(tmp_path / str(size), f"--num_envs={size}", *flags) == 0
    one, three = played(tmp_path / "1")["ball"], played(tmp_path / "3")["ball"]
    for name in one:
        for a, b in zip(one[name], three[name], strict=True):
            assert (a["episode"], a["steps"], a["success"]) == (
                b["episode"],
                b["steps"],
                b["success"],
            )
            assert a["reward"] == pytest.approx(b["reward"], rel=1e-3, abs=1e-6)


def test_videos_of_the_first_scenarios_do_not_change_the_results(
    tmp_path: Path, artifact_dir: Path, short: list[str]
) -> None:
    flags = [f"--policy.path={artifact_dir}", "--controllers=planner,hold", "--episodes=3", *short]
    assert run(tmp_path / "plain", "--num_envs=2", *flags) == 0
    assert run(tmp_path / "drawn", "--num_envs=2", "--videos=1", *flags) == 0
    videos = sorted(path.name for path in (tmp_path / "drawn").glob("*.gif"))
    assert videos == ["rollout-ball-hold-0.gif", "rollout-ball-planner-0.gif"]
    with Image.open(tmp_path / "drawn" / videos[1]) as video:
        assert video.n_frames == -(-played(tmp_path / "drawn")["ball"]["planner"][0]["steps"] // 2)
    if find_spec("av"):
        assert len(list((tmp_path / "drawn").glob("*.mp4"))) == 2
    assert not list((tmp_path / "plain").glob("*.gif"))
    assert played(tmp_path / "drawn") == played(tmp_path / "plain")


def test_a_sequence_reports_the_success_of_each_part(
    tmp_path: Path, artifact_dir: Path, short: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    best = {"action": [0.2] * ACTION_DIM, "reward_mean": 0.0, "success_rate": 0.5, "episodes": 9}
    (tmp_path / "constant.json").write_text(json.dumps({"constants": {"sequence": best}}))
    flags = [
        "--task=sequence",
        f"--policy.path={artifact_dir}",
        f"--constant.path={tmp_path / 'constant.json'}",
        "--episodes=2",
        "--env.sequence.parts=[ball,wall]",
        "--env.wall_episode={ticks: 6, event_ticks: [3, 3]}",
        *short,
    ]
    assert run(tmp_path / "out", *flags) == 0, capsys.readouterr().err
    figures = json.loads((tmp_path / "out" / "eval.json").read_text())["sequence"]
    assert set(figures) == {"planner", "hold", "constant", "random", "oracle"}
    for row in figures.values():
        assert set(row) == KEYS | {"parts"}
        assert set(row["parts"]) == {"ball", "wall"}
    for scores in played(tmp_path / "out")["sequence"].values():
        assert all(score["steps"] == 15 + 6 or score["terminated"] for score in scores)
        assert all(score["success"] == all(score["parts"].values()) for score in scores)
    assert "- wall" in capsys.readouterr().out


def test_all_are_the_tasks_that_models_are_trained_on() -> None:
    assert EvalConfig(task="all").tasks == ("ball", "wall", "arch")


def test_worker_processes_give_the_same_scores(tmp_path: Path, short: list[str]) -> None:
    flags = ["--controllers=hold", "--episodes=2", "--num_envs=1", *short]
    for workers in (1, 2):
        assert run(tmp_path / str(workers), *flags, f"--num_workers={workers}") == 0
    assert played(tmp_path / "1") == played(tmp_path / "2")


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (["--task=ball2"], 2, "did you mean 'ball'"),
        (["--controllers=hold,planer"], 2, "did you mean 'planner'"),
        (["--episodes=0"], 2, "--episodes=0"),
        (["--num_envs=0"], 2, "--num_envs=0"),
        (["--num_workers=-1"], 2, "--num_workers=-1"),
        (["--controllers=planner"], 2, "--policy.path is missing"),
        (["--policy.path=/nowhere/policy"], 4, "/nowhere/policy"),
        (["--controllers=constant", "--constant.path=/nowhere.json"], 3, "/nowhere.json"),
        (["--controllers=ppo"], 2, "--ppo.path is missing"),
        (["--controllers=ppo", "--ppo.path=/nowhere.safetensors"], 4, "/nowhere.safetensors"),
        (["--seed=-3"], 2, "--seed=-3"),
        (["--env.ball.radiu=1"], 2, "unknown option"),
    ],
)
def test_bad_input_ends_with_one_line_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], code: int, message: str
) -> None:
    out = tmp_path / "out"
    assert run(out, *flags) == code
    captured = capsys.readouterr()
    assert message in captured.err
    assert len(captured.err.strip().splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize("objective", ["reward", "td"])
def test_one_artifact_is_played_by_every_objective(
    tmp_path: Path, earning_artifact_dir: Path, short: list[str], objective: str
) -> None:
    flags = ["--controllers=planner", "--episodes=2", *short, f"--planner.objective={objective}"]
    assert run(tmp_path / "out", f"--policy.path={earning_artifact_dir}", *flags) == 0
    assert len(played(tmp_path / "out")["ball"]["planner"]) == 2


def test_objective_td_needs_a_model_with_a_reward_head(
    tmp_path: Path, artifact_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--controllers=planner", "--env.controller=stance", "--planner.objective=td"]
    assert run(tmp_path / "out", f"--policy.path={artifact_dir}", *flags) == 2
    assert "train it with --policy.loss.reward=1" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_policy_without_a_model_plays_the_same_scenarios(
    tmp_path: Path, short: list[str]
) -> None:
    toy_reactive(StanceController().id).save(tmp_path / "ppo.safetensors")
    flags = ["--controllers=hold,ppo", "--episodes=3", *short]
    for size in (1, 3):
        named = [f"--ppo.path={tmp_path / 'ppo.safetensors'}", f"--num_envs={size}"]
        assert run(tmp_path / str(size), *named, *flags) == 0
    one, three = (played(tmp_path / size)["ball"]["ppo"] for size in ("1", "3"))
    assert [score["episode"] for score in one] == [0, 1, 2]
    rewards = [score["reward"] for score in three]
    assert [score["reward"] for score in one] == pytest.approx(rewards, rel=1e-4)
    figures = json.loads((tmp_path / "1" / "eval.json").read_text())
    assert set(figures["ball"]["ppo"]) == KEYS
    assert figures["ball"]["ppo"]["reward_mean"] != figures["ball"]["hold"]["reward_mean"]


def test_a_policy_of_another_controller_is_not_played(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toy_reactive("another-controller").save(tmp_path / "ppo.safetensors")
    named = f"--ppo.path={tmp_path / 'ppo.safetensors'}"
    assert run(tmp_path / "out", "--controllers=ppo", named) == 4
    assert "another-controller" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_results_are_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "eval.json").write_text("precious")
    assert run(tmp_path, "--controllers=hold") == 2
    assert "eval.json" in capsys.readouterr().err
    assert (tmp_path / "eval.json").read_text() == "precious"


def test_an_artifact_of_another_controller_is_not_evaluated(
    tmp_path: Path, foreign_artifact_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(out, f"--policy.path={foreign_artifact_dir}", "--controllers=planner") == 4
    assert "another-controller" in capsys.readouterr().err
    assert not out.exists()


def test_a_diverging_simulation_is_an_error_that_names_the_episode(
    tmp_path: Path,
    short: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(robot, "MAX_SPEED", 2.0)  # m/s; a ball is faster
    assert run(tmp_path / "out", "--controllers=hold", "--episodes=1", *short) == 3
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert "the simulation diverged in task ball, seed " in message
    assert "velocity of ball is" in message


@pytest.mark.parametrize("command", ["evaluate", "deploy"])
def test_int8_is_refused_before_any_work_where_it_cannot_be_used(
    command: str,
    tmp_path: Path,
    artifact_dir: Path,
    short: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(library, "compiler", lambda: None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    library.load_kernel.cache_clear()
    out = tmp_path / "out"
    flags = [f"--policy.path={artifact_dir}", f"--output_dir={out}", "--planner.backend=int8"]
    try:
        assert {"evaluate": main, "deploy": deploy}[command]([*flags, *short]) == 5
    finally:
        library.load_kernel.cache_clear()
    message = capsys.readouterr().err
    assert "there is no C compiler" in message
    assert "plan with --planner.backend=float32" in message
    assert not out.exists()


def test_recorded_paths_are_absolute(
    tmp_path: Path, artifact_dir: Path, short: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(artifact_dir.parent)
    flags = [f"--policy.path={artifact_dir.name}", "--controllers=planner", "--episodes=1"]
    assert run(tmp_path / "out", *flags, *short) == 0
    config = json.loads((tmp_path / "out" / "eval_run.json").read_text())["config"]
    assert config["policy"]["path"] == str(artifact_dir)


def _interrupt_at_group(monkeypatch: pytest.MonkeyPatch, number: int, signals: int = 1) -> None:
    """Send this process SIGINT when that group of episodes begins."""
    original, groups = episodes.play_group, itertools.count(1)

    def play(*args: Any) -> list[EpisodeScore]:
        if next(groups) == number:
            for _ in range(signals):
                signal.raise_signal(signal.SIGINT)
        return original(*args)

    monkeypatch.setattr(episodes, "play_group", play)


@pytest.mark.parametrize("signals", [1, 2])
def test_an_interrupted_evaluation_keeps_complete_episodes(
    signals: int,
    tmp_path: Path,
    short: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _interrupt_at_group(monkeypatch, 3, signals)
    out = tmp_path / "out"
    flags = ["--controllers=hold,random", "--episodes=6", "--num_envs=2", *short]
    before = signal.getsignal(signal.SIGINT)
    assert run(out, *flags) == 130
    assert signal.getsignal(signal.SIGINT) == before
    figures = json.loads((out / "eval.json").read_text())
    assert set(figures) == {"ball"}
    assert set(figures["ball"]) == {"hold"}
    row = figures["ball"]["hold"]
    assert (row["incomplete"], row["episodes"], row["episodes_requested"]) == (True, 4, 6)
    record = json.loads((out / "eval_run.json").read_text())
    assert record["complete"] is False
    assert [score["episode"] for score in record["episodes"]["ball"]["hold"]] == [0, 1, 2, 3]
    printed = capsys.readouterr().out
    assert "ball  hold" in printed
    assert "INCOMPLETE: ball hold 4 of 6, ball random 0 of 6 episodes played" in printed


def test_an_evaluation_interrupted_at_its_start_writes_no_figures(
    tmp_path: Path, short: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _interrupt_at_group(monkeypatch, 1)
    assert run(tmp_path / "out", "--controllers=hold", "--episodes=2", *short) == 130
    assert list((tmp_path / "out").iterdir()) == []


def test_an_error_keeps_complete_episodes(
    tmp_path: Path, short: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    original, groups = episodes.play_group, itertools.count(1)

    def play(*args: Any) -> list[EpisodeScore]:
        if next(groups) == 2:
            raise SimulationDiverged("the simulation diverged")
        return original(*args)

    monkeypatch.setattr(episodes, "play_group", play)
    out = tmp_path / "out"
    assert run(out, "--controllers=hold", "--episodes=4", "--num_envs=2", *short) == 3
    row = json.loads((out / "eval.json").read_text())["ball"]["hold"]
    assert (row["incomplete"], row["episodes"], row["episodes_requested"]) == (True, 2, 4)


def test_episodes_that_have_ended_in_an_interrupted_group_count(config: EnvConfig) -> None:
    env, ticks = VectorEnv(config, 2, render_depth=False), itertools.count()
    scenarios = [Scenario("ball", 0, number) for number in range(2)]
    toppled = ReferencePolicy(reference("hold"), env, lambda: scenarios)
    advance = toppled.advance

    def push(sent: Any) -> None:
        env.instances[1].robot.data.qvel[0] = 5.0
        advance(sent)

    toppled.advance = push  # type: ignore[method-assign]
    (score,) = episodes.play_group(env, toppled, scenarios, lambda: next(ticks) > 30, ())
    assert (score.episode, score.terminated) == (1, True)


def test_a_closed_pool_has_closed_its_environments(
    config: EnvConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[VectorEnv] = []
    monkeypatch.setattr(VectorEnv, "close", lambda env: closed.append(env))
    with closing(EpisodePool(EvalConfig(env=config, num_workers=1))) as pool:
        for count in (1, 2):
            scenarios = tuple(Scenario("ball", 0, number) for number in range(count))
            list(pool.play([EpisodeGroup("hold", scenarios)] * 2))
        assert not closed
    assert [env.num_envs for env in closed] == [1, 2]


def test_workers_load_the_version_that_was_loaded(
    artifact_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Hub id without a revision names another version after a push."""
    started: dict[str, Any] = {}
    monkeypatch.setattr(episodes, "ProcessPoolExecutor", lambda *_, **given: started.update(given))
    EpisodePool(EvalConfig(PolicyOptions("me/policy", "main")), load_artifact(str(artifact_dir)))
    config, _ = started["initargs"]
    assert config.policy == PolicyOptions(str(artifact_dir))


@pytest.mark.slow
def test_stopped_workers_abandon_their_episodes(config: EnvConfig) -> None:
    received: list[int] = []
    groups = [EpisodeGroup("hold", (Scenario("ball", 0, number),)) for number in range(40)]
    options = EvalConfig(env=config, num_workers=2)
    with closing(EpisodePool(options, stopped=lambda: bool(received))) as pool:
        played = []
        for _, scores in pool.play(groups):
            played += scores
            received.append(1)
    assert 1 <= len(played) < 40
