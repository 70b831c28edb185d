"""Single terms of the value of a plan, alone and in closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from egovcp.artifact import Artifact, load_artifact, save_artifact
from egovcp.model import PRESETS
from egovcp.plan import PlannerConfig, ReferenceEvaluator
from egovcp.robot.controllers import WALK, make_controller
from egovcp.sim.base_env import Observation
from egovcp.sim.env import VectorEnv
from egovcp.sim.scenario import HELD_OUT, Scenario
from egovcp.testing import toy_model
from egovcp_experiment.cell import read_json
from egovcp_experiment.studies import plan_terms
from egovcp_experiment.studies.plan_terms import TERMS, TermPolicy, main, term_evaluator


def test_terms_are_the_values_whose_mean_the_planner_maximises(policy: Path) -> None:
    artifact = load_artifact(policy)
    model, planner = artifact.world_model, replace(artifact.planner, horizon=4, backend="eager")
    artifact = replace(artifact, planner=planner)
    carry = model.initial(2)
    actions = torch.rand(2, 3, 4, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for threshold in (1.0, 0.0):  # no plan fails, or all do
        artifact = replace(artifact, planner=replace(planner, termination_threshold=threshold))
        with torch.no_grad():
            terms = [term_evaluator(artifact, n).at(carry)(actions, None) for n in (1, 2, 3, 4)]
            mean = ReferenceEvaluator(model, artifact.planner).at(carry)(actions, None)
            first = model.value(model.expand_candidates(carry), actions[..., 0, :])
        torch.testing.assert_close(torch.stack(terms).mean(0), mean)
        torch.testing.assert_close(terms[0], first)
        failed = torch.allclose(terms[3], model.min_return, atol=1e-6)
        assert failed == (threshold == 0.0)


def test_a_policy_of_a_term_plans_by_it(policy: Path) -> None:
    artifact = load_artifact(policy)
    assert TermPolicy(artifact, "first", num_envs=2, seed=0).prepare().n == 1
    last = TermPolicy(artifact, "last", num_envs=2, seed=0)
    assert last.prepare().n == artifact.planner.horizon
    assert last.config == artifact.planner


def test_all_terms_play_the_scenarios_of_evaluations(
    flags: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds, sent = [], list[torch.Tensor]()
    reset, random_plans = VectorEnv.reset, plan_terms._random_plans

    def recorded(env: VectorEnv, scenarios: Sequence[Scenario]) -> Observation:
        seeds.extend(scenario.seed for scenario in scenarios)
        return reset(env, scenarios)

    def planned(artifact: Artifact, last: torch.Tensor, rng: torch.Generator) -> torch.Tensor:
        sent.append(last)
        return random_plans(artifact, last, rng)

    monkeypatch.setattr(VectorEnv, "reset", recorded)
    monkeypatch.setattr(plan_terms, "_random_plans", planned)
    assert main([*flags, "--task=ball", "--seed=3"]) == 0
    assert seeds == [HELD_OUT + 3] * 4
    found = read_json(tmp_path / "out" / "result.json")
    assert list(found["terms"]) == list(TERMS)
    assert [row["steps"] for row in found["terms"].values()] == [[32, 32]] * 2
    assert found["horizon"] == len(found["spread"]) == 2
    assert all(value > 0 for value in found["spread"])
    assert not sent[0].any()  # plans begin at the action before the observation
    assert sent[1].any()


def test_another_objective_is_refused(
    flags: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = PRESETS["debug"]
    model = toy_model(replace(config, loss=replace(config.loss, reward=1.0)))
    provenance = {"controller_id": make_controller(WALK).id}
    save_artifact(tmp_path / "rewards", model, PlannerConfig(objective="td"), provenance)
    assert main([*flags, f"--policy.path={tmp_path / 'rewards'}"]) == 2
    assert "--planner.objective=td: expected value" in capsys.readouterr().err
