import math

import numpy as np
import pytest

from egovcp.data import ReturnConfig, is_terminal, mc_return, mc_valid
from egovcp.errors import UsageError
from egovcp.spec import REWARD_TERMS


def _naive_return(reward: np.ndarray, t: int, gamma: float, steps: int) -> float:
    total = 0.0
    for i in range(steps):
        if t + i < len(reward):
            total += gamma**i * float(reward[t + i])
    return total


@pytest.mark.parametrize(("length", "steps"), [(1, 50), (7, 50), (120, 50), (60, 1), (60, 60)])
def test_return_equals_the_naive_sum(length: int, steps: int) -> None:
    reward = np.random.default_rng(length).normal(size=length).astype(np.float32)
    expected = [_naive_return(reward, t, 0.97, steps) for t in range(length)]
    np.testing.assert_allclose(mc_return(reward, 0.97, steps), expected, rtol=1e-5, atol=1e-6)


def test_the_target_has_the_weighted_terms_without_those_of_the_action() -> None:
    terms = np.random.default_rng(0).normal(size=(6, len(REWARD_TERMS)))
    by_name = dict(zip(REWARD_TERMS, terms.T, strict=True))
    found = ReturnConfig().target_reward(terms.sum(1), terms)
    rest = terms.sum(1) - by_name["pose"] - by_name["action_rate"]
    np.testing.assert_allclose(found, rest, atol=1e-6)
    weighted = ReturnConfig(weights={"block": 2.0, "pose": 1.0}).target_reward(terms.sum(1), terms)
    np.testing.assert_allclose(weighted, rest + by_name["block"] + by_name["pose"], atol=1e-6)


def test_without_recorded_terms_the_target_is_the_reward() -> None:
    reward = np.arange(4, dtype=np.float32)
    found = ReturnConfig().target_reward(reward, np.zeros((4, len(REWARD_TERMS))))
    np.testing.assert_array_equal(found, reward)


@pytest.mark.parametrize(
    ("weights", "message"),
    [({"blok": 2.0}, "did you mean 'block'"), ({"block": math.nan}, "expected a finite number")],
)
def test_unknown_terms_and_weights_are_refused(weights: dict[str, float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ReturnConfig(weights=weights).check()


def test_a_constant_reward_gives_the_geometric_sum() -> None:
    value = mc_return(np.ones(80), gamma=0.9, steps=10)
    assert value[0] == pytest.approx((1 - 0.9**10) / (1 - 0.9))
    assert value[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("length", [1, 40, 100, 149, 150])
def test_validity_depends_on_the_plan_and_not_on_the_outcome(length: int) -> None:
    survivor = mc_valid(150, time_limit=150, steps=50)
    np.testing.assert_array_equal(mc_valid(length, time_limit=150, steps=50), survivor[:length])
    assert survivor.sum() == 101  # t = 0..100


def test_truncated_returns_can_be_kept() -> None:
    assert mc_valid(60, time_limit=60, steps=50, keep_truncated=True).all()


def test_only_a_failure_is_terminal() -> None:
    done = np.array([False, False, True])
    assert is_terminal(done, np.array([False] * 3)).tolist() == [False, False, True]
    assert not is_terminal(done, done).any()
