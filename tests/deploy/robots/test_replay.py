"""Replay of recorded runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from egovcp.artifact import load_artifact
from egovcp.errors import DataError, UsageError
from egovcp.log.mcap import McapSink
from egovcp.log.mcap_reader import Recording, read_recording
from egovcp.log.tick import RunInfo, Sink, Tick
from egovcp.plan import Policy, PolicyStep
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp_deploy.pilot.pilot import REJECTED
from egovcp_deploy.pilot.planner import SKIPPED, InlinePlanner, PlannerRunner
from egovcp_deploy.robots.replay import RECORDING_ENDS, ReplayRobot, open_recordings
from egovcp_deploy.robots.sim import SimRobot
from egovcp_deploy.rollouts import run_rollout
from tests.support.sinks import MemorySink

TICKS = 12
CONFIG = EnvConfig(controller="stance", ball_episode=EpisodeConfig(TICKS, (2, 3), 0.0))


class Watched:
    """A policy whose carry and value are written down each tick."""

    def __init__(self, policy: Policy, askew: float = 0.0) -> None:
        self._policy, self._askew = policy, askew
        self.carries: list[torch.Tensor] = []
        self.values: list[float] = []

    def reset(self) -> None:
        self._policy.reset()

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        step = self._policy.act(depth, state)
        self.carries.append(self._policy.carry.features.clone())
        self.values.append(float(step.value[0]))
        return step._replace(action=step.action + self._askew)

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        self._policy.observe(depth, state)

    def advance(self, sent: NDArray[np.floating]) -> None:
        self._policy.advance(sent)


def watched(artifact_dir: Path, askew: float = 0.0) -> Watched:
    return Watched(load_artifact(str(artifact_dir)).make_policy(1, seed=5), askew)


def run(policy: Watched, robot: SimRobot | ReplayRobot, sink: Sink) -> None:
    run_rollout(InlinePlanner(PlannerRunner(policy)), robot, sink)


def play(policy: Watched, robot: ReplayRobot, episode: int = 0) -> list[Tick]:
    sink = MemorySink()
    robot.start(episode)
    run(policy, robot, sink)
    return sink.ticks


@pytest.fixture(scope="module")
def recorded(
    artifact_dir: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[Watched]]:
    """Two simulated rollouts on disk, and what the policy thought."""
    folder, thoughts = tmp_path_factory.mktemp("runs"), []
    robot = SimRobot(CONFIG, "ball", seed=1)
    for episode in range(2):
        policy, sink = watched(artifact_dir), McapSink(folder / f"rollout-{episode}.mcap")
        robot.start(episode)
        sink.open(
            RunInfo(
                "ball",
                episode=episode,
                camera=robot.camera,
                hashes={"low_level_controller": robot.controller_id},
            )
        )
        run(policy, robot, sink)
        sink.close()
        thoughts.append(policy)
    robot.close()
    return folder, thoughts


@pytest.mark.parametrize("askew", [0.0, 0.5])
@pytest.mark.parametrize("episode", [0, 1])
def test_replay_repeats_the_recurrence_bit_for_bit(
    recorded: tuple[Path, list[Watched]], artifact_dir: Path, episode: int, askew: float
) -> None:
    folder, thoughts = recorded
    again = watched(artifact_dir, askew)  # whatever it plans now, what was sent was sent
    ticks = play(again, open_recordings(folder), episode)
    then = thoughts[episode]
    assert len(ticks) == len(then.carries) == TICKS
    for a, b in zip(again.carries, then.carries, strict=True):
        assert torch.equal(a, b)
    assert again.values == then.values


def test_replay_does_not_keep_plans_in_memory(
    recorded: tuple[Path, list[Watched]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recorded[0] / "rollout-0.mcap"
    assert any(tick.candidates is not None for tick in read_recording(path).ticks)
    read = []

    def spy(*args: Any, **options: Any) -> Recording:
        read.append(read_recording(*args, **options))
        return read[-1]

    monkeypatch.setattr("egovcp_deploy.robots.replay.read_recording", spy)
    open_recordings(path)
    for tick in read[0].ticks:
        assert (tick.candidates, tick.plan, tick.depth_imagined) == (None, None, None)


def test_replay_returns_everything_recorded(
    recorded: tuple[Path, list[Watched]], artifact_dir: Path
) -> None:
    folder, _ = recorded
    robot = open_recordings(folder / "rollout-1.mcap")
    ticks = play(watched(artifact_dir), robot)
    live = SimRobot(CONFIG, "ball", seed=1)
    live.start(1)
    assert robot.controller_id == live.controller_id
    assert robot.camera == live.camera
    for tick in ticks:
        seen = live.observe()
        np.testing.assert_array_equal(tick.depth, seen.depth)
        np.testing.assert_array_equal(tick.state, seen.state)
        np.testing.assert_allclose(tick.base, seen.base)
        outcome = live.act(tick.action_sent)
        assert tick.reward == pytest.approx(outcome.reward, abs=1e-6)
        assert tick.terminated == outcome.terminated
    assert ticks[-1].truncated
    live.close()


def test_a_live_run_begins_with_the_first_tick_in_run(
    recorded: tuple[Path, list[Watched]], tmp_path: Path
) -> None:
    """While the robot stands up the planner runs along; its recurrence starts anew with RUN."""
    ticks = read_recording(recorded[0] / "rollout-0.mcap").ticks
    standing = [replace(t, index=i, mode="stand") for i, t in enumerate(ticks)]
    running = [replace(t, index=TICKS + i) for i, t in enumerate(ticks)]
    assert running[0].mode == "run"
    write(tmp_path / "live.mcap", RunInfo("ball"), [*standing, *running])
    robot = open_recordings(tmp_path / "live.mcap")
    np.testing.assert_array_equal(robot.observe().state, ticks[0].state)
    ended = [robot.act(np.zeros(7)).truncated for _ in range(TICKS)]
    assert ended == [False] * (TICKS - 1) + [True]


def test_recorded_events_are_marked(recorded: tuple[Path, list[Watched]], tmp_path: Path) -> None:
    """They are not those of the plans that the replay makes."""
    recording = read_recording(recorded[0] / "rollout-0.mcap")
    lines = (SKIPPED, REJECTED, "run -> hold: the planner has ended")
    write(tmp_path / "a.mcap", recording.info, [replace(t, events=lines) for t in recording.ticks])
    robot = open_recordings(tmp_path / "a.mcap")
    assert robot.act(np.zeros(7)).events == tuple(f"recorded: {line}" for line in lines)


@pytest.mark.parametrize(
    "names",
    [
        ["rollout-2", "rollout-9", "rollout-10"],
        ["run1-rollout-9", "run1-rollout-10", "run2-rollout-1"],
        ["rollout-1", "rollout-²"],
    ],
)
def test_recordings_are_played_in_the_order_of_their_numbers(
    names: list[str], recorded: tuple[Path, list[Watched]], tmp_path: Path
) -> None:
    for name in names:
        (tmp_path / f"{name}.mcap").symlink_to(recorded[0] / "rollout-0.mcap")
    assert [path.stem for path in open_recordings(tmp_path).files] == names


def write(path: Path, info: RunInfo, ticks: list[Tick]) -> None:
    sink = McapSink(path)
    sink.open(info)
    for tick in ticks:
        sink.write(tick)
    sink.close()


def test_missing_ticks_are_reported(
    recorded: tuple[Path, list[Watched]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = read_recording(recorded[0] / "rollout-0.mcap")
    open_recordings(recorded[0] / "rollout-0.mcap")
    assert capsys.readouterr().err == ""
    write(tmp_path / "gap.mcap", recording.info, [*recording.ticks[:3], *recording.ticks[5:]])
    open_recordings(tmp_path / "gap.mcap")
    assert "gap.mcap: 2 ticks are missing" in capsys.readouterr().err


def test_recordings_of_different_controllers_are_refused(
    recorded: tuple[Path, list[Watched]], tmp_path: Path
) -> None:
    recording = read_recording(recorded[0] / "rollout-0.mcap")
    other = replace(recording.info, hashes={"low_level_controller": "another"})
    write(tmp_path / "rollout-0.mcap", recording.info, recording.ticks)
    write(tmp_path / "rollout-1.mcap", other, recording.ticks)
    robot = open_recordings(tmp_path)
    with pytest.raises(DataError, match=r"rollout-1\.mcap.*'another', expected"):
        robot.start(1)


def test_a_torn_recording_ends_truncated(
    recorded: tuple[Path, list[Watched]], artifact_dir: Path, tmp_path: Path
) -> None:
    whole = (recorded[0] / "rollout-0.mcap").read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole[: len(whole) * 2 // 3])
    ticks = play(watched(artifact_dir), open_recordings(torn))
    assert 0 < len(ticks) < TICKS
    assert ticks[-1].truncated
    assert RECORDING_ENDS in ticks[-1].events


def test_missing_recordings_are_reported(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no recording, or folder of recordings"):
        open_recordings(tmp_path)
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(DataError):
        open_recordings(tmp_path / "empty.mcap")


def test_a_dataset_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    with pytest.raises(UsageError, match="egovcp-dataset viz"):
        open_recordings(tmp_path)
