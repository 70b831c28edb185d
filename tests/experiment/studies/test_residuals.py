"""Branches start where the plan was made, follow it, and part ways after it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egovcp.data import ReturnConfig
from egovcp.policy_options import PolicyOptions
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp_collect.config import CollectConfig
from egovcp_experiment.cell import read_json
from egovcp_experiment.studies.residuals import (
    STEPS,
    ResidualsConfig,
    _branches,
    _Start,
    analysis,
    bounds,
    main,
)


def _config(ticks: int) -> EnvConfig:
    quiet = EpisodeConfig(ticks=ticks, event_ticks=(3, 3), empty_probability=1.0)
    return EnvConfig(controller="stance", ball_episode=quiet, pose_cost=0.01, action_rate_cost=0.0)


def _branch(
    ticks: int, steps: int, plan: np.ndarray, walk: RandomWalk, pose_weight: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    point = _Start(Scenario("ball", 0, 0), [np.zeros(7)] * 2, {}, {})
    rngs = np.random.default_rng(0).spawn(2 * STEPS)
    returns = ReturnConfig(gamma=0.5, steps=steps, weights={"pose": pose_weight})
    return _branches(_config(ticks), point, plan, walk, rngs, returns)


def test_returns_start_at_the_action_of_each_step() -> None:
    """In an empty scene the reward is the cost of the pose, -0.01 mean(a^2), known in advance."""
    plan = np.repeat(np.linspace(0.1, 0.3, STEPS)[:, None], 7, axis=1)
    short, whole = _branch(2 + STEPS, 1, plan, RandomWalk())
    np.testing.assert_allclose(short, np.repeat(-0.01 * plan[:, :1] ** 2, 2, axis=1), rtol=1e-9)
    np.testing.assert_allclose(whole[-1], short[-1])  # the episode ends with the plan
    assert (whole[:-1] < short[:-1]).all()


def test_returns_weight_the_reward_terms_as_in_training() -> None:
    plan = np.repeat(np.linspace(0.1, 0.3, STEPS)[:, None], 7, axis=1)
    short, _ = _branch(2 + STEPS, 1, plan, RandomWalk(), pose_weight=3.0)
    np.testing.assert_allclose(short, np.repeat(-0.03 * plan[:, :1] ** 2, 2, axis=1), rtol=1e-9)
    _, whole = _branch(2 + STEPS, 1, plan, RandomWalk(), pose_weight=0.0)
    assert not whole.any()


def test_walks_differ_after_the_plan() -> None:
    short, whole = _branch(20, 6, np.zeros((STEPS, 7)), RandomWalk())
    assert (short[:, 0] != short[:, 1]).all()
    assert (np.abs(whole) >= np.abs(short)).all()


def test_a_resting_walk_holds_the_last_action_of_the_plan() -> None:
    """A rest of 100 ticks is all but never over within the 6 ticks after the plan: what is counted
    is the cost of standing where the plan ended, -0.01 mean(a^2) in each tick."""
    plan = np.repeat(np.linspace(0.1, 0.3, STEPS)[:, None], 7, axis=1)
    resting = RandomWalk(step_ticks=(100, 100))
    short, _ = _branch(2 + STEPS + 6, 6, plan, resting)
    discounts = 0.5 ** np.arange(6)
    for k in range(STEPS):
        stood = -0.01 * plan[k, 0] ** 2 * discounts.sum()
        assert np.isclose(short[k], stood, rtol=1e-9).any()


def test_the_walk_is_that_of_the_collector_by_default() -> None:
    study, data = ResidualsConfig(), CollectConfig()
    assert (study.eta, study.step_ticks) == (data.eta, data.step_ticks)
    assert study.boundary == data.boundary


def test_times_between_steps_in_the_wrong_order_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"--output_dir={tmp_path / 'out'}", "--step_ticks=[5,3]"]) == 2
    assert "--step_ticks=[5, 3]: expected 1 <= shortest" in capsys.readouterr().err


def test_a_policy_that_was_not_trained_on_returns_is_warned_about(
    policy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ResidualsConfig(policy=PolicyOptions(path=str(policy))).load()
    assert "trained with q_target=privileged, not on returns" in capsys.readouterr().err


@pytest.mark.slow
def test_the_study_measures_both_kinds_of_plans(flags: list[str], tmp_path: Path) -> None:
    few = [flag for flag in flags if not flag.startswith("--episodes")]
    assert main([*few, "--episodes=3", "--branches=2", "--task=ball"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["return_steps"] == 8
    for row in found["plans"].values():
        assert row["plans"] == 3
        assert [at["n"] for at in row["horizons"]] == list(range(1, STEPS + 1))


@pytest.fixture(autouse=True)
def _few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("egovcp.eval_scores._RESAMPLES", 200)


def plans(
    rho: float, noise: float, bias: float = 0.0, count: int = 4000
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of deviation 0.5 whose steps correlate by rho; returns of 4 walks with that noise."""
    rng = np.random.default_rng(0)
    steps, walks = 4, 4
    common = rng.normal(size=(count, 1)) * rho**0.5
    errors = 0.5 * (common + rng.normal(size=(count, steps)) * (1 - rho) ** 0.5) + bias
    truth = rng.normal(size=(count, steps))
    returns = truth[:, :, None] + noise * rng.normal(size=(count, steps, walks))
    return truth + errors, returns, returns - 0.25


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_noise_of_the_returns_is_subtracted(rho: float) -> None:
    found = analysis(*plans(rho, noise=2.0, bias=0.1))
    np.testing.assert_allclose(found["sigma"], 0.5, atol=0.06)
    assert found["rho_next"] == pytest.approx(rho, abs=0.12)
    np.testing.assert_allclose(found["bias"], 0.1, atol=0.06)
    np.testing.assert_allclose(found["bias_of_cutting"], 0.25)


@pytest.mark.parametrize("rho", [0.0, 0.3, 1.0])
def test_the_variance_of_a_mean_lies_between_its_bounds(rho: float) -> None:
    for at in analysis(*plans(rho, noise=0.0))["horizons"]:
        n = at["n"]
        assert at["variance"] == pytest.approx(0.25 * (1 + (n - 1) * rho) / n, rel=0.1)
        assert at["v_lb"] <= at["variance"] * 1.001
        assert at["variance"] <= at["v_ub"] * 1.001
        assert at["error"] == pytest.approx(at["variance"] + at["bias"] ** 2)


def test_the_remaining_share_has_an_interval_over_plans() -> None:
    found = analysis(*plans(0.3, noise=1.0))
    low, high = found["share_4_ci95"]
    assert low < found["share_4"] < high
    assert low < 0.25 * (1 + 3 * 0.3) < high
    assert found["rho_next_ci95"][0] < 0.3 < found["rho_next_ci95"][1]


def test_a_share_of_a_variance_that_may_be_zero_is_unknown() -> None:
    value, returns, whole = plans(0.0, noise=4.0, count=100)
    value = returns.mean(2) + 0.1 * np.random.default_rng(1).normal(size=value.shape)
    found = analysis(value, returns, whole)
    assert found["share_4"] is None
    assert found["share_4_ci95"] is None
    value, returns, whole = plans(0.0, noise=0.0, count=100)
    value[:, 0] = returns[:, 0].mean(1) + 1e-5 * value[:, 0]
    assert analysis(value, returns, whole)["share_4"] is None


def test_the_bounds_are_those_of_the_paper() -> None:
    assert bounds(1, 0.3, 0.5, 0.9) == pytest.approx((0.09, 0.25))
    assert bounds(4, 0.5, 0.5, 0.0) == pytest.approx((0.0625, 0.0625))
    low, high = bounds(4, 0.5, 0.5, 0.5)
    assert (low, high) == (0.0, pytest.approx((4 + 0.5 * 12) / 16 * 0.25))


def test_two_plans_are_too_few() -> None:
    assert analysis(*plans(0.0, 1.0, count=2)) == {"plans": 2}
