import numpy as np
import pytest

from egovcp.data import is_terminal, mc_return, mc_valid


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
