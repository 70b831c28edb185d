"""Plan times are those of a planner that has planned before."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from egovcp.plan import Policy, PolicyStep
from egovcp_deploy import episodes
from egovcp_deploy.deploy import main as deploy
from egovcp_deploy.evaluate import main as evaluate
from egovcp_deploy.pilot import planner

FIRST_PLAN_S, PLAN_S = 1.0, 0.008


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time passes in plans alone: a second in the first one of each policy, then 8 ms."""
    now, known = [0.0], set[int]()
    act: Callable[..., PolicyStep] = Policy.act

    def timed(self: Policy, *args: Any) -> PolicyStep:
        now[0] += PLAN_S if id(self) in known else FIRST_PLAN_S
        known.add(id(self))
        return act(self, *args)

    monkeypatch.setattr(Policy, "act", timed)
    for module in (episodes, planner):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now[0]))


@pytest.mark.usefixtures("clock")
def test_an_evaluation_does_not_time_the_first_plan(
    tmp_path: Path, artifact_dir: Path, short: list[str]
) -> None:
    flags = [
        *(f"--policy.path={artifact_dir}", f"--output_dir={tmp_path / 'out'}", *short),
        *("--controllers=planner", "--episodes=3", "--num_envs=2", "--num_workers=1"),
    ]
    assert evaluate(flags) == 0
    figures = json.loads((tmp_path / "out" / "eval.json").read_text())["ball"]["planner"]
    assert figures["plan_ms_p50"] == pytest.approx(1e3 * PLAN_S / 2)
    assert figures["plan_ms_p99"] <= 1e3 * PLAN_S + 1e-6


@pytest.mark.usefixtures("clock")
def test_a_rollout_does_not_time_the_first_plan(
    tmp_path: Path, artifact_dir: Path, short: list[str]
) -> None:
    flags = [f"--policy.path={artifact_dir}", "--episodes=1", f"--output_dir={tmp_path / 'out'}"]
    assert deploy([*flags, "--log.rrd=false", "--log.videos=0", *short]) == 0
    (row,) = json.loads((tmp_path / "out" / "deploy.json").read_text())["rollouts"]
    assert row["plan_ms_p99"] == pytest.approx(1e3 * PLAN_S)
