"""`egovcp-deploy`: refuses bad input before any work, records what it plays."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp import packages
from egovcp.log.mcap_reader import read_recording
from egovcp.log.viewer import LiveRerun
from egovcp.sim import robot
from egovcp.sim.config import CameraConfig, EnvConfig
from egovcp.spec import ACTION_RATE_LIMIT, COMMAND_SLICE
from egovcp_deploy import deploy, recording
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.deploy import main
from egovcp_deploy.live.hardware import CameraOptions, RobotOptions
from egovcp_deploy.robots.base import ActionResult
from egovcp_deploy.robots.realsense_camera import RealSenseConfig
from egovcp_deploy.robots.sim import SimRobot
from tests.support.sinks import MemorySink

#: The recording alone; drawing it takes longer than the rollout.
UNDRAWN = ("--log.rrd=false", "--log.videos=0")
#: What ``auto`` may stand for.
BACKENDS = ("float32", "int8")


def run(*flags: str) -> int:
    return main(list(flags))


def test_rollouts_are_recorded_and_summed_up(
    tmp_path: Path, artifact_dir: Path, short: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code = run(
        f"--policy.path={artifact_dir}", "--episodes=2", "--seed=3", f"--output_dir={out}", *short
    )
    assert code == 0, capsys.readouterr().err
    names = {path.name for path in out.iterdir()}
    assert names == {
        "deploy.json",
        "rollout-0.gif",
        "rollout-0.mp4",
        "rollout-0.png",
        *(f"rollout-{i}.{kind}" for i in (0, 1) for kind in ("mcap", "rrd")),
    }
    report = json.loads((out / "deploy.json").read_text())
    assert report["backend"] in BACKENDS
    assert [row["episode"] for row in report["rollouts"]] == [0, 1]
    for i, row in enumerate(report["rollouts"]):
        played = read_recording(out / row["mcap"])
        assert played.complete
        assert row["rrd"] == f"rollout-{i}.rrd"
        assert played.info.backend == report["backend"]
        assert (played.info.seed, played.info.episode) == (3, i)
        assert "model.safetensors" in played.info.hashes
        assert len(played.ticks) == row["steps"] == 15
        assert np.mean([t.reward for t in played.ticks]) == pytest.approx(row["reward_mean"])
        assert played.ticks[-1].success == row["success"]
    text = capsys.readouterr().out
    assert "rollout 0:" in text
    assert "rollout-0.rrd" in text


def test_all_rollouts_are_shown_in_one_spawned_viewer(
    tmp_path: Path, short: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A spawned viewer stays open and keeps its port, so that a second one cannot start."""
    shown: list[MemorySink] = []
    starts: list[str] = []

    def sink(log: object, name: str, warn: object) -> MemorySink:
        shown.append(MemorySink())
        return shown[-1]

    monkeypatch.setattr(LiveRerun, "__enter__", lambda live: starts.append(live.kind) or live)
    monkeypatch.setattr(recording, "AsyncSink", sink)
    flags = ["--controller=hold", "--episodes=2", "--log.live=spawn", f"--output_dir={tmp_path}"]
    assert run(*flags, *short, *UNDRAWN) == 0
    assert starts == ["spawn"]
    assert [len(viewer.ticks) for viewer in shown] == [15, 15]


def test_a_recording_has_the_format_of_the_data(
    tmp_path: Path, artifact_dir: Path, short: list[str]
) -> None:
    out = tmp_path / "out"
    flags = [f"--policy.path={artifact_dir}", "--episodes=1", f"--output_dir={out}"]
    run(*flags, *short, *UNDRAWN)
    ticks = read_recording(out / "rollout-0.mcap").ticks
    sent = np.array([tick.action_sent for tick in ticks])
    steps = np.diff(sent, axis=0, prepend=np.zeros((1, 7)))
    assert np.abs(steps).max() <= ACTION_RATE_LIMIT + 1e-6
    commands = [tick.state[COMMAND_SLICE].tolist() for tick in ticks]
    assert commands[0] != commands[2], "the command in o_t is the last one sent"
    assert any("ball thrown" in tick.events for tick in ticks)
    assert all(tick.base is not None for tick in ticks)
    assert [len(tick.scene) for tick in ticks][-1] == 1
    assert ticks[-1].truncated
    assert not any(tick.truncated for tick in ticks[:-1])


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (["--task=bal"], 2, "did you mean 'ball'"),
        (["--robot.type=simm"], 2, "did you mean 'sim'"),
        (["--episodes=0"], 2, "--episodes=0"),
        (["--imagine=-1"], 2, "--imagine=-1"),
        (["--no_such_flag=1"], 2, "--no_such_flag"),
        (["--policy.path=/nowhere/policy"], 4, "/nowhere/policy"),
        (["--policy.path="], 2, "name the artifact, or choose a reference that needs none"),
        (["--policy.path=", "--robot.type=unitree_g1"], 2, "is missing; name the artifact\n"),
        (["--seed=-1"], 2, "--seed=-1"),
        (["--planner.samples=2"], 2, "elites"),
        (["--output_dir="], 2, "--output_dir"),
        (["--operator.type=keyboard", "--operator.duration=3"], 2, "press h to hold the robot"),
        (
            [
                "--robot.type=unitree_g1",
                "--policy.path=/nowhere",
                "--robot.camera.type=realsense",
            ],
            2,
            "lists as --robot.camera.realsense.serial",
        ),
    ],
)
def test_bad_input_ends_with_one_line_before_any_work(
    tmp_path: Path,
    artifact_dir: Path,
    capsys: pytest.CaptureFixture[str],
    flags: list[str],
    code: int,
    message: str,
) -> None:
    out = tmp_path / "out"
    assert run(f"--policy.path={artifact_dir}", f"--output_dir={out}", *flags) == code
    captured = capsys.readouterr()
    assert message in captured.err
    assert len(captured.err.strip().splitlines()) == 1
    assert not out.exists()


def test_results_are_never_overwritten(
    tmp_path: Path, artifact_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rollout-0.mcap").write_bytes(b"precious")
    assert run(f"--policy.path={artifact_dir}", f"--output_dir={tmp_path}") == 2
    assert "rollout-0.mcap" in capsys.readouterr().err
    assert (tmp_path / "rollout-0.mcap").read_bytes() == b"precious"


def test_an_artifact_of_another_controller_is_refused(
    tmp_path: Path, foreign_artifact_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(f"--policy.path={foreign_artifact_dir}", f"--output_dir={out}") == 4
    assert "another-controller" in capsys.readouterr().err
    assert not out.exists()


def test_each_event_of_an_episode_is_logged_once(tmp_path: Path, artifact_dir: Path) -> None:
    out = tmp_path / "out"
    flags = ["--env.ball_episode.ticks=40", "--env.ball_episode.event_ticks=[2,2]", "--imagine=0"]
    flags += ["--env.controller=stance", *UNDRAWN]
    run(f"--policy.path={artifact_dir}", "--episodes=1", f"--output_dir={out}", *flags)
    ticks = read_recording(out / "rollout-0.mcap").ticks
    events = [event for tick in ticks for event in tick.events]
    assert "ball thrown" in ticks[2].events
    assert len(set(events)) == len(events)
    paid = {"block": "blocked by a hand", "hit": "body hit"}
    for term, text in paid.items():
        first = next((t for t in ticks if t.reward_terms[term] != 0), None)
        assert (text in events) == (first is not None)
        assert first is None or text in first.events


@pytest.mark.slow
def test_the_events_of_a_sequence_are_those_of_its_parts(tmp_path: Path) -> None:
    flags = ["--env.arch.distance_range=[0.8,0.8]", "--env.sequence.parts=[arch,ball]"]
    flags += ["--env.arch_episode.event_ticks=[2,2]", "--env.sequence.pause_ticks=5"]
    flags += ["--env.ball_episode.ticks=40", "--env.ball_episode.event_ticks=[2,2]"]
    played = ["--task=sequence", "--controller=oracle", "--episodes=1", "--seed=3"]
    assert run(*played, *flags, *UNDRAWN, f"--output_dir={tmp_path / 'out'}") == 0
    ticks = read_recording(tmp_path / "out" / "rollout-0.mcap").ticks
    assert [event for tick in ticks for event in tick.events] == [
        "passage begins",
        "passed",
        "ball thrown",
        "blocked by a hand",
    ]
    (row,) = json.loads((tmp_path / "out" / "deploy.json").read_text())["rollouts"]
    assert row["parts"] == {"arch": True, "ball": True}


def test_a_reference_needs_no_artifact_and_logs_no_plan(
    tmp_path: Path, short: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    flags = ["--controller=oracle", "--episodes=1", "--seed=3", f"--output_dir={out}"]
    assert run(*flags, *short, *UNDRAWN) == 0, capsys.readouterr().err
    ticks = read_recording(out / "rollout-0.mcap").ticks
    assert len(ticks) == 15
    assert all(t.plan is None and t.candidates is None and t.value is None for t in ticks)
    assert any(t.action_sent.any() for t in ticks), "the oracle moves its hands to the ball"
    report = json.loads((out / "deploy.json").read_text())
    assert report["artifact"] is None
    assert report["low_level_controller"].startswith("g1-stance")


def test_the_environment_is_recorded(tmp_path: Path, artifact_dir: Path, short: list[str]) -> None:
    out = tmp_path / "out"
    flags = [f"--policy.path={artifact_dir}", "--episodes=1", f"--output_dir={out}"]
    assert run(*flags, *short, *UNDRAWN) == 0
    report = json.loads((out / "deploy.json").read_text())
    env = report["config"]["env"]
    assert env["wall"]["push_speed_range"] == list(EnvConfig().wall.push_speed_range)
    assert read_recording(out / "rollout-0.mcap").info.config == report["config"]


def test_a_replay_has_task_seed_and_episode_of_its_recording(
    tmp_path: Path, artifact_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = ["--env.controller=stance", "--env.wall_episode={ticks: 5, event_ticks: [3, 3]}"]
    flags = ["--task=wall", "--controller=hold", "--episodes=2", "--seed=3"]
    assert run(*flags, *scenes, *UNDRAWN, f"--output_dir={tmp_path / 'played'}") == 0
    (tmp_path / "played" / "rollout-0.mcap").unlink()
    monkeypatch.setenv("HOME", str(tmp_path))
    out = tmp_path / "again"
    again = ["--robot.type=replay", "--robot.recordings=~/played", f"--policy.path={artifact_dir}"]
    assert run(*again, *UNDRAWN, f"--output_dir={out}") == 0
    report = json.loads((out / "deploy.json").read_text())
    (row,) = report["rollouts"]
    info = read_recording(out / "rollout-0.mcap").info
    for found in ((info.task, info.seed, info.episode), (row["task"], row["seed"], row["episode"])):
        assert found == ("wall", 3, 1)
    assert row["mcap"] == "rollout-0.mcap"
    assert "task" not in report, "another recording may be of another task"
    assert "rrd" not in row, "a file that was not written"


def test_a_simulated_robot_needs_no_camera_driver(
    tmp_path: Path, short: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "pyrealsense2")
    flags = ["--controller=hold", "--episodes=1", "--robot.camera.type=realsense"]
    assert run(*flags, *short, *UNDRAWN, f"--output_dir={tmp_path / 'out'}") == 0


@pytest.mark.parametrize(("flags", "task"), [([], ""), (["--task=wall"], "wall")])
def test_the_task_of_a_real_robot_is_recorded_if_it_is_given(
    flags: list[str],
    task: str,
    tmp_path: Path,
    artifact_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driven: list[DeployConfig] = []
    monkeypatch.setattr(deploy, "drive", lambda config, artifact: driven.append(config))
    given = ["--robot.type=unitree_g1", f"--policy.path={artifact_dir}", *flags]
    assert run(*given, f"--output_dir={tmp_path / 'out'}") == 0
    assert recording.make_run_info(driven[0], "walk", None, "").task == task


def test_the_camera_of_a_real_robot_is_the_configured_one() -> None:
    config = DeployConfig(
        robot=RobotOptions(
            camera=CameraOptions(type="realsense", realsense=RealSenseConfig(vertical_fov=0.8))
        ),
        env=EnvConfig(camera=CameraConfig(position=(0.1, 0.0, 0.5), pitch_range=(0.1, 0.3))),
    )
    camera = recording.make_run_info(config, "walk", None, "").camera
    assert (camera.position, camera.pitch, camera.vertical_fov) == ((0.1, 0.0, 0.5), 0.2, 0.8)


def test_planner_options_change_the_planner(
    tmp_path: Path, artifact_dir: Path, short: list[str]
) -> None:
    out = tmp_path / "out"
    flags = [f"--policy.path={artifact_dir}", "--episodes=1", f"--output_dir={out}"]
    assert run(*flags, "--planner.horizon=5", "--planner.elites=2", *short, *UNDRAWN) == 0
    tick = read_recording(out / "rollout-0.mcap").ticks[0]
    assert tick.plan is not None
    assert tick.plan.shape == (5, 7)
    assert tick.candidates is not None
    assert len(tick.candidates.values) == 2


@pytest.fixture
def interrupted_in(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Makes Ctrl-C come in the middle of the rollout of that number."""

    def arrange(episode: int) -> None:
        act = SimRobot.act

        def interrupted(robot: SimRobot, action: NDArray[np.float64]) -> ActionResult:
            if robot.scenario.episode == episode and robot.env.tick[0] == 4:
                signal.raise_signal(signal.SIGINT)
            return act(robot, action)

        monkeypatch.setattr(SimRobot, "act", interrupted)

    return arrange


def test_an_interrupt_leaves_the_summary_of_complete_rollouts(
    tmp_path: Path,
    short: list[str],
    interrupted_in: Callable[[int], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    interrupted_in(2)
    out = tmp_path / "out"
    flags = ["--controller=hold", "--episodes=4", f"--output_dir={out}"]
    assert run(*flags, *short, *UNDRAWN) == 130
    report = json.loads((out / "deploy.json").read_text())
    assert [row["episode"] for row in report["rollouts"]] == [0, 1]
    assert report["config"]["episodes"] == 4
    for row in report["rollouts"]:
        assert len(read_recording(out / row["mcap"]).ticks) == row["steps"] == 15
    assert len(read_recording(out / "rollout-2.mcap").ticks) == 4
    assert not (out / "rollout-3.mcap").exists()
    captured = capsys.readouterr()
    assert captured.out.count("rollout 0:") == 1
    assert captured.err.endswith("egovcp-deploy: interrupted\n")


def test_an_interrupt_in_the_first_rollout_leaves_no_summary(
    tmp_path: Path, short: list[str], interrupted_in: Callable[[int], None]
) -> None:
    interrupted_in(0)
    out = tmp_path / "out"
    assert run("--controller=hold", f"--output_dir={out}", *short, *UNDRAWN) == 130
    assert not (out / "deploy.json").exists()


def test_without_the_simulator_the_error_names_the_package(tmp_path: Path) -> None:
    """All that does not need the simulator is loaded without it."""
    code = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from egovcp_deploy.deploy import main\n"
        f"sys.exit(main(['--controller=hold', '--output_dir={tmp_path / 'out'}']))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 5
    assert "--robot.type=sim needs mujoco, which is not installed" in ended.stderr
    assert "pip install 'egovcp-deploy[sim]'" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_an_unknown_controller_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--controller=orcale", f"--output_dir={tmp_path / 'x'}") == 2
    assert "oracle" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_a_diverging_simulation_is_an_error_that_names_the_episode(
    tmp_path: Path,
    short: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(robot, "MAX_SPEED", 2.0)  # m/s; a ball is faster
    out = tmp_path / "out"
    assert run("--controller=hold", "--episodes=1", f"--output_dir={out}", *short) == 3
    assert "the simulation diverged in task ball" in capsys.readouterr().err
    assert not (out / "deploy.json").exists()
