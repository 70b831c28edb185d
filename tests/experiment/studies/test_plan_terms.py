"""Single terms of the value of a plan, alone and in closed loop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from egovcp.artifact import load_artifact, save_artifact
from egovcp.model import PRESETS
from egovcp.plan import PlannerConfig, ReferenceEvaluator
from egovcp.robot.controllers import WALK, make_controller
from egovcp.testing import toy_model
from egovcp_experiment.cell import read_json
from egovcp_experiment.studies.plan_terms import TERMS, TermEvaluator, TermPolicy, main, term_values


def test_terms_are_q_along_the_imagined_plan() -> None:
    model = toy_model()
    model.termination_head.rest[-1].bias.data.fill_(-50.0)  # type: ignore[union-attr]
    carry = model.initial(2)
    actions = torch.rand(2, 3, 4, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.no_grad():
        values = term_values(model, carry, actions)
        for n in (1, 4):
            config = PlannerConfig(horizon=n)
            mean = ReferenceEvaluator(model, config).at(carry)(actions[..., :n, :], None)
            torch.testing.assert_close(values[..., :n].mean(-1), mean)
        by_term = {t: TermEvaluator(model, t).at(carry)(actions, None) for t in TERMS}
    assert torch.equal(by_term["first"], values[..., 0])
    assert torch.equal(by_term["last"], values[..., -1])
    assert not torch.equal(by_term["first"], by_term["last"])


def test_a_policy_of_a_term_plans_by_it(policy: Path) -> None:
    artifact = load_artifact(policy)
    artifact = replace(artifact, planner=replace(artifact.planner, mirror=False, pose_cost=0.0))
    found = TermPolicy(artifact, "last", num_envs=2, seed=0)
    assert found.prepare() == TermEvaluator(artifact.world_model, "last")
    assert found.config == artifact.planner


def test_all_terms_play_the_same_scenarios(flags: list[str], tmp_path: Path) -> None:
    assert main([*flags, "--task=ball"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert list(found["terms"]) == list(TERMS)
    assert [row["steps"] for row in found["terms"].values()] == [[32, 32]] * 3
    assert found["horizon"] == len(found["spread"]) == 2
    assert all(value > 0 for value in found["spread"])


def test_another_objective_is_refused(
    flags: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = PRESETS["debug"]
    model = toy_model(replace(config, loss=replace(config.loss, reward=1.0)))
    provenance = {"controller_id": make_controller(WALK).id}
    save_artifact(tmp_path / "rewards", model, PlannerConfig(objective="td"), provenance)
    assert main([*flags, f"--policy.path={tmp_path / 'rewards'}"]) == 2
    assert "--planner.objective=td: expected value" in capsys.readouterr().err
