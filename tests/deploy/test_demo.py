"""`egovcp-demo`: one rollout of a policy, with files that are easy to find."""

from __future__ import annotations

from pathlib import Path

import pytest

from egovcp.log.mcap_reader import read_recording
from egovcp.log.rollout_video import AHEAD
from egovcp_deploy.demo import DemoConfig, main

FILES = {f"rollout.{kind}" for kind in ("gif", "mcap", "mp4", "png", "rrd")}


def test_without_options_the_shipped_policy_plays_all_tasks() -> None:
    config = DemoConfig()
    assert (config.policy.path, config.task) == ("contact", "sequence")
    assert config.output_dir == "outputs/demo"
    assert config.env.sequence.parts == ("arch", "ball", "wall")


def test_the_result_of_each_part_is_printed_and_the_rollout_recorded(
    tmp_path: Path,
    artifact_dir: Path,
    short: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = ["--env.sequence.parts=[ball,wall]", "--env.sequence.pause_ticks=2"]
    flags += ["--env.wall_episode.ticks=12", "--env.wall_episode.event_ticks=[3,3]"]
    code = main([f"--policy.path={artifact_dir}", *short, *flags])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    out = Path("outputs/demo")
    assert {path.name for path in out.iterdir()} == FILES
    recording = read_recording(out / "rollout.mcap")
    assert recording.complete
    assert recording.info.config["episodes"] == 1
    assert recording.info.config["imagine"] == AHEAD, "as far as the video shows"
    assert recording.info.task == "sequence"
    printed = captured.out.splitlines()
    assert printed[0].startswith("rollout 0: ")
    assert [line.split(":")[0].strip() for line in printed[1:3]] == ["ball", "wall"]
    assert all(line.endswith(("success", "failure")) for line in printed[1:3])
    assert printed[3:] == [
        "video: outputs/demo/rollout.gif",
        f"view it with: rerun {out}/rollout.rrd",
    ]


@pytest.mark.slow
def test_a_single_task_and_an_own_policy(
    tmp_path: Path, artifact_dir: Path, short: list[str]
) -> None:
    out = tmp_path / "out"
    code = main([f"--policy.path={artifact_dir}", "--task=ball", f"--output_dir={out}", *short])
    assert code == 0
    assert {path.name for path in out.iterdir()} == FILES
    assert len(read_recording(out / "rollout.mcap").ticks) == 15


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (["--task=bal"], 2, "did you mean 'ball'"),
        (["--policy.path="], 2, "--policy.path is missing"),
        (["--policy.path=/nowhere"], 4, "/nowhere"),
        (["--env.controller=walk"], 4, "with low-level controller"),
        (["--episodes=3"], 2, "--episodes"),
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
    assert main([f"--policy.path={artifact_dir}", f"--output_dir={out}", *flags]) == code
    captured = capsys.readouterr()
    assert message in captured.err
    assert len(captured.err.strip().splitlines()) == 1
    assert not out.exists()


def test_recordings_are_never_overwritten(
    tmp_path: Path, artifact_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rollout.gif").write_bytes(b"precious")
    assert main([f"--policy.path={artifact_dir}", f"--output_dir={tmp_path}"]) == 2
    assert "rollout.gif already; results are never overwritten" in capsys.readouterr().err
