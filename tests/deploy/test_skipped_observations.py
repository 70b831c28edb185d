"""A state that is not finite is skipped, logged and counted, and the run continues."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egovcp.log.mcap_reader import read_recording
from egovcp.plan import PlannerConfig, Policy
from egovcp.sim.base_env import Observation, StepResult
from egovcp.sim.env import VectorEnv
from egovcp.spec import ACTION_DIM, STATE_DIM
from egovcp.testing import toy_model
from egovcp_deploy.deploy import main as deploy
from egovcp_deploy.evaluate import main as evaluate
from egovcp_deploy.live.link import encode_observation
from egovcp_deploy.live.operators import AutomaticOperator
from egovcp_deploy.live.planner_loop import PlannerLoop
from egovcp_deploy.pilot.planner import SKIPPED, ObservationMessage, PlannerRunner
from tests.support.lockstep import LockstepClock
from tests.support.sinks import MemorySink

BAD_TICK, TICK_NS = 5, 40_000_000
PLANNER = PlannerConfig(samples=16, horizon=3, iterations=1, elites=4)


@pytest.fixture
def one_nan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every episode of the simulator senses one NaN, at one tick, in its first robot."""
    step = VectorEnv.step

    def damaged(self: VectorEnv, action: np.ndarray) -> StepResult:
        result = step(self, action)
        if self.tick[0] != BAD_TICK:
            return result
        state = result.observation.state.copy()
        state[0, 20] = np.nan
        return replace(result, observation=Observation(result.observation.depth, state))

    monkeypatch.setattr(VectorEnv, "step", damaged)


@pytest.mark.usefixtures("one_nan")
def test_a_rollout_counts_skipped_observations(
    tmp_path: Path, artifact_dir: Path, short: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    flags = [f"--policy.path={artifact_dir}", "--episodes=1", f"--output_dir={out}", *short]
    assert deploy([*flags, "--log.rrd=false", "--log.videos=0"]) == 0
    (row,) = json.loads((out / "deploy.json").read_text())["rollouts"]
    assert row["skipped_observations"] == 1
    assert row["rejected_plans"] == 0
    assert "1 observations skipped" in capsys.readouterr().out
    ticks = read_recording(out / row["mcap"]).ticks
    assert [tick.index for tick in ticks if SKIPPED in tick.events] == [BAD_TICK]
    after = np.stack([tick.action_planned for tick in ticks[BAD_TICK:]])
    assert np.isfinite(after).all()
    assert np.abs(np.diff(after, axis=0)).max(1).min() > 0, "the policy is frozen"


@pytest.mark.usefixtures("one_nan")
def test_an_evaluation_counts_skipped_observations_per_robot(
    tmp_path: Path, artifact_dir: Path, short: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [
        *(f"--policy.path={artifact_dir}", f"--output_dir={tmp_path / 'out'}", *short),
        *("--controllers=planner,hold", "--episodes=2", "--num_envs=2", "--num_workers=1"),
    ]
    assert evaluate(flags) == 0
    played = json.loads((tmp_path / "out" / "eval_run.json").read_text())["episodes"]["ball"]
    assert [score["skipped"] for score in played["planner"]] == [1, 0]
    assert [score["skipped"] for score in played["hold"]] == [0, 0]
    assert "1 observations were not finite" in capsys.readouterr().out


class _Control:
    """The control process at the other end of the link; reports three ticks at once at times."""

    def __init__(self, clock: LockstepClock, bad: set[int], together: int, ticks: int = 12) -> None:
        self._clock, self._bad, self._together, self._ticks = clock, bad, together, ticks
        self._tick = 0
        self.plans = 0

    def alive(self) -> bool:
        return self._tick < self._ticks

    def send(self, parts: list[bytes]) -> bool:
        self.plans += len(parts) == 2  # header and plan
        return True

    def receive(self, timeout_s: float = 0.0) -> Iterator[list[bytes]]:
        self._clock.advance(TICK_NS)
        for _ in range(self._together):
            state = np.zeros(STATE_DIM, np.float32)
            state[5] = np.nan if self._tick in self._bad else -1.0
            depth, sent = np.zeros((48, 64), np.uint16), np.zeros(ACTION_DIM)
            now, first = self._clock.now_ns(), self._tick == 0
            yield encode_observation(
                ObservationMessage(self._tick, now, depth, state, sent, first, "run")
            )
            self._tick += 1


@pytest.mark.parametrize("together", [1, 3])
def test_the_live_planner_counts_skipped_observations(together: int) -> None:
    clock, sink = LockstepClock(), MemorySink()
    runner = PlannerRunner(Policy(toy_model(), PLANNER, 1))
    control = _Control(clock, {4, 8}, together)
    operator = AutomaticOperator()
    loop = PlannerLoop(runner, control, operator, sink, clock, control.alive)  # type: ignore[arg-type]
    summary = loop.run()
    assert summary.failure is None
    assert summary.skipped == 2
    events = [event for tick in sink.ticks for event in tick.events]
    assert events.count(SKIPPED) == 2
    assert control.plans == 12 // together
