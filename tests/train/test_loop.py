"""One optimiser step, the schedule and the budget."""

import copy
import dataclasses
import itertools
from typing import Any, Literal

import pytest
import torch

from egovcp.cuda_graphs import GraphedFunction
from egovcp.errors import DataError
from egovcp.model import PRESETS, Batch
from egovcp.model.privileged_value import PrivilegedValue
from egovcp.plan import PlannerConfig
from egovcp.testing import random_batch, toy_model
from egovcp_train.config import OptimizerConfig
from egovcp_train.loop import Budget, Learner
from egovcp_train.privileged_value import Critic
from tests.support.cuda_graphs import RecomputingCapture

CONFIG = OptimizerConfig(warmup_steps=0)


def _learner(config: OptimizerConfig = CONFIG) -> Learner:
    return Learner(toy_model(), config, seed=0)


def _critic(seed: int = 0) -> Critic:
    torch.manual_seed(seed)
    value = PrivilegedValue(random_batch(2, 3).privileged.shape[-1])
    return Critic(value, PlannerConfig(), lr=1e-3)


def _with_critic(seed: int = 0) -> Learner:
    learner = Learner(toy_model(seed=seed), CONFIG, seed=seed)
    learner.critic = _critic(seed)
    return learner


def _weights(learner: Learner) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in learner.model.state_dict().items()}


def _same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[k], b[k]) for k in a)


def _bad() -> Batch:
    batch = random_batch(2, 3)
    batch.mc_return[0, 0] = torch.nan
    return batch


# --- numbers that are none ------------------------------------------------------------------
def test_a_step_that_is_not_finite_changes_nothing() -> None:
    learner = _learner()
    learner.update(random_batch(2, 3), 0.0)
    before, averaged = _weights(learner), learner.averaged.state_dict()
    averaged = {k: v.clone() for k, v in averaged.items()}
    learner.update(_bad(), 0.0)
    assert _same(before, _weights(learner))
    assert _same(averaged, learner.averaged.state_dict())


def test_the_third_such_step_in_a_row_ends_the_run() -> None:
    learner = _learner()
    learner.update(_bad(), 0.0)
    learner.update(_bad(), 0.0)
    with pytest.raises(DataError, match="not finite in 3 consecutive steps"):
        learner.update(_bad(), 0.0)


def test_a_good_step_in_between_is_forgiven() -> None:
    learner = _learner()
    for _ in range(3):
        learner.update(_bad(), 0.0)
        learner.update(_bad(), 0.0)
        learner.update(random_batch(2, 3), 0.0)
    assert learner.step == 9
    assert all(v.isfinite().all() for v in _weights(learner).values())


# --- learning -------------------------------------------------------------------------------
def test_updates_bring_the_loss_down() -> None:
    learner, batch = _learner(dataclasses.replace(CONFIG, lr=4e-3)), random_batch(4, 4)
    losses = [float(learner.update(batch, 0.0)["loss/total"]) for _ in range(25)]
    assert losses[-1] < 0.8 * losses[0]


def test_a_seed_repeats_the_updates_bit_for_bit() -> None:
    one, two = _learner(), _learner()
    for seed in range(3):
        one.update(random_batch(2, 3, seed), 0.0)
        two.update(random_batch(2, 3, seed), 0.0)
    assert _same(_weights(one), _weights(two))


def test_the_state_restores_a_learner_bit_for_bit() -> None:
    straight, stopped, other = _with_critic(), _with_critic(), _with_critic(seed=9)
    for seed in range(2):
        straight.update(random_batch(2, 3, seed), 0.3)
        stopped.update(random_batch(2, 3, seed), 0.3)
    other.load_state_dict(stopped.state_dict())
    for seed in range(2, 4):
        straight.update(random_batch(2, 3, seed), 0.5)
        other.update(random_batch(2, 3, seed), 0.5)
    assert _same(_weights(straight), _weights(other))
    assert _same(straight.averaged.state_dict(), other.averaged.state_dict())
    assert straight.step == other.step == 4
    assert straight.critic is not None
    assert other.critic is not None
    assert _same(straight.critic.value.state_dict(), other.critic.value.state_dict())


def test_the_critic_is_trained_too_once_q_ranks_actions() -> None:
    learner = _with_critic()
    assert learner.critic is not None
    before = copy.deepcopy(learner.critic.value.state_dict())
    assert "loss/critic" not in learner.update(random_batch(2, 3), 0.09)
    assert _same(before, learner.critic.value.state_dict())
    assert learner.update(random_batch(2, 3), 0.1)["loss/critic"] > 0
    assert not _same(before, learner.critic.value.state_dict())


def test_a_step_with_a_bad_reward_changes_neither_model_nor_critic() -> None:
    learner, batch = _with_critic(), random_batch(2, 3)
    assert learner.critic is not None
    learner.update(batch, 0.5)
    before, critic = _weights(learner), copy.deepcopy(learner.critic.state_dict())
    batch.reward[0, 0] = torch.nan
    learner.update(batch, 0.5)
    assert _same(before, _weights(learner))
    after = learner.critic.state_dict()
    assert after["updates"] == critic["updates"]
    assert all(_same(after[name], critic[name]) for name in ("value", "target"))


def test_a_critic_that_is_not_finite_is_not_saved() -> None:
    learner = _with_critic()
    assert learner.critic is not None
    learner.require_finite()
    learner.critic.parameters[0].data.fill_(torch.nan)
    with pytest.raises(DataError, match="weights are not finite"):
        learner.require_finite()


# --- recorded steps -------------------------------------------------------------------------
@pytest.mark.parametrize("dynamics", ["joint", "autoregressive"])
@pytest.mark.parametrize("q_target", ["mc", "td", "privileged"])
def test_recorded_steps_learn_the_same_bit_for_bit(
    dynamics: Literal["joint", "autoregressive"], q_target: Literal["mc", "td", "privileged"]
) -> None:
    loss = dataclasses.replace(PRESETS["debug"].loss, q_target=q_target, decode_every=2)
    config = dataclasses.replace(PRESETS["debug"], dynamics=dynamics, loss=loss)
    plain, recorded = (Learner(toy_model(config), CONFIG, seed=0) for _ in range(2))
    if q_target == "privileged":
        plain.critic, recorded.critic = _critic(), _critic()
    recorder = RecomputingCapture()
    recorded._gradients = GraphedFunction(
        recorded._compute_gradients, recorder, max_graphs=64, copies=False
    )
    for seed in range(12):
        expected = plain.update(random_batch(2, 6, seed), 0.5)
        found = recorded.update(random_batch(2, 6, seed), 0.5)
        assert found.keys() == expected.keys()
        assert all(found[name].equal(value) for name, value in expected.items())
    assert _same(_weights(plain), _weights(recorded))
    assert 1 < recorder.captures < 12  # one for each row that may be the first
    assert not recorded.capture_error


def test_a_step_that_cannot_be_recorded_is_made_and_says_why() -> None:
    def refuse(function: object, device: torch.device) -> Any:
        raise RuntimeError("operation not permitted")

    learner, plain = _learner(), _learner()
    assert not learner.capture_error
    learner._gradients = GraphedFunction(learner._compute_gradients, refuse, copies=False)
    for seed in range(3):
        learner.update(random_batch(2, 3, seed), 0.0)
        plain.update(random_batch(2, 3, seed), 0.0)
    assert _same(_weights(learner), _weights(plain))
    assert learner.capture_error == "operation not permitted"


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("bf16", [False, True])
def test_on_a_gpu_steps_are_recorded_and_the_same(bf16: bool) -> None:
    recorded, plain = (Learner(toy_model().cuda(), CONFIG, seed=0, bf16=bf16) for _ in range(2))
    assert isinstance(recorded._gradients, GraphedFunction)
    plain._gradients = plain._compute_gradients
    for seed in range(24):
        batch = Batch(*(x.cuda() for x in random_batch(4, 8, seed)))
        found, expected = (x.update(batch, 0.0) for x in (recorded, plain))
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, rtol=2e-2, atol=2e-3, msg=name)
    assert not recorded.capture_error
    assert len(recorded._gradients._graphs) > 1  # one for each row that may be the first


# --- averaging ------------------------------------------------------------------------------
def test_without_averaging_the_average_is_the_model() -> None:
    learner = _learner(dataclasses.replace(CONFIG, ema=0.0))
    learner.update(random_batch(2, 3), 0.0)
    assert _same(_weights(learner), learner.averaged.state_dict())


def test_the_average_lags_between_start_and_now() -> None:
    learner = _learner(dataclasses.replace(CONFIG, ema=0.9))
    start = dict(_weights(learner))
    for _ in range(5):
        learner.update(random_batch(2, 3), 0.0)
    now, mean = _weights(learner), learner.averaged.state_dict()
    name = "gru.norm.bias"
    travelled, lag = (now[name] - start[name]).norm(), (now[name] - mean[name]).norm()
    assert 0 < lag < travelled
    assert not any(p.requires_grad for p in learner.averaged.parameters())


# --- schedule -------------------------------------------------------------------------------
def test_the_rate_warms_up_and_decays_to_a_tenth() -> None:
    learner = _learner(OptimizerConfig(lr=1.0, warmup_steps=10))
    rates = []
    for step in range(100):
        learner.step = step
        rates.append(learner.learning_rate(step / 99))
    assert rates[0] == pytest.approx(0.1, rel=0.01)
    assert max(rates) == rates[9]
    assert all(a >= b for a, b in itertools.pairwise(rates[9:]))
    assert rates[-1] == pytest.approx(0.1)


class _Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_budget_of_steps_ignores_the_clock() -> None:
    clock = _Clock()
    budget = Budget(200, 0.0, clock)
    clock.now += 1e6
    assert [budget.progress(step) for step in (0, 50, 200, 300)] == [0.0, 0.25, 1.0, 1.0]


def test_progress_begins_after_the_fit_of_the_critic() -> None:
    clock = _Clock()
    budget = Budget(200, 2.0, clock, spent=40.0, fit_seconds=30.0)
    assert budget.progress(0) == pytest.approx(10 / 90)
    assert budget.progress(50) == pytest.approx(0.25)
    clock.now += 80.0
    assert budget.progress(10) == 1.0
    assert Budget(200, 2.0, clock, spent=150.0, fit_seconds=150.0).progress(0) == 1.0


def test_a_budget_of_minutes_ends_with_whichever_comes_first() -> None:
    clock = _Clock()
    budget = Budget(200, 2.0, clock)
    clock.now += 60.0
    assert budget.progress(10) == pytest.approx(0.5)
    assert budget.progress(150) == pytest.approx(0.75)
    clock.now += 61.0
    assert budget.progress(10) == 1.0
