from __future__ import annotations

import numpy as np
import pytest

from egovcp.errors import UsageError
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import Constant, EnvPolicy, Hold, Oracle, RandomWalk, reflect
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM, ACTION_ETA


def walk(env: VectorEnv, policy: RandomWalk, ticks: int, first: int = 0) -> np.ndarray:
    """(T, B, 7) wanted actions."""
    scenarios = [Scenario("ball", 0, first + i) for i in range(env.num_envs)]
    policy.reset(env, scenarios)
    return np.array([policy.act(env) for _ in range(ticks)])


@pytest.mark.parametrize("boundary", ["reflect", "clip"])
def test_a_walk_stays_in_the_box_in_steps_of_eta_at_most(env: VectorEnv, boundary: str) -> None:
    actions = walk(env, RandomWalk(boundary=boundary), 300)
    assert np.abs(actions).max() <= 1.0
    assert np.abs(np.diff(actions, axis=0)).max() <= ACTION_ETA


def test_reflection_fills_the_box_evenly_and_clipping_piles_up(env: VectorEnv) -> None:
    even, piled = (walk(env, RandomWalk(boundary=b), 2000)[100:] for b in ("reflect", "clip"))
    assert np.mean(np.abs(even) > 0.9) == pytest.approx(0.1, abs=0.02)
    assert np.mean(np.abs(piled) > 0.9) > 0.15


def test_random_walk_steps_at_the_configured_intervals(env: VectorEnv) -> None:
    actions = walk(env, RandomWalk(eta=1.0, step_ticks=(3, 5)), 2000)
    moved = np.diff(actions, axis=0) != 0.0  # (T - 1, B, 7)
    steps = moved.all(-1)
    np.testing.assert_array_equal(steps, moved.any(-1))  # all seven targets, or none
    every = np.diff(np.flatnonzero(steps[:, 0]))
    assert set(every) == {3, 4, 5}
    assert np.abs(np.diff(actions, axis=0)).max() > ACTION_ETA
    assert np.abs(actions).max() <= 1.0


def test_long_waits_are_seen_more_often_at_a_random_time(env: VectorEnv) -> None:
    """Rests of 1 and 2 ticks, equally many: a tick is the only one of a rest, the first of two or
    the last of two with the same probability, and a step follows at once in two cases of three."""
    policy, rows = RandomWalk(step_ticks=(1, 2)), 3000
    stood = np.full((rows, ACTION_DIM), 0.2)
    policy.start_at(stood, np.random.default_rng(0).spawn(rows))
    waits = np.isclose(policy.act(env), stood).all(-1)
    assert waits.mean() == pytest.approx(1 / 3, abs=0.03)
    assert not np.isclose(policy.act(env), stood)[waits].all(-1).any()
    policy.start_rows_at([1], np.full((1, ACTION_DIM), -0.2))
    np.testing.assert_allclose(policy.act(env)[1], -0.2, atol=ACTION_ETA)


def test_a_random_walk_depends_on_its_scenario_only(env: VectorEnv) -> None:
    np.testing.assert_array_equal(
        walk(env, RandomWalk(), 5, first=0)[:, 2], walk(env, RandomWalk(), 5, first=2)[:, 0]
    )


def test_reflection_is_a_mirror() -> None:
    np.testing.assert_allclose(reflect(np.array([-1.3, 0.4, 1.2])), [-0.7, 0.4, 0.8])


def test_constants_need_seven_numbers(env: VectorEnv) -> None:
    env.reset([Scenario("ball", 0, i) for i in range(env.num_envs)])
    with pytest.raises(UsageError, match="expected actions of shape"):
        env.step(Constant([0.0] * 3).act(env))


def outcome(env: VectorEnv, policy: EnvPolicy, task: str) -> tuple[float, float]:
    """Success rate and mean return of one episode per row."""
    scenarios = [Scenario(task, 0, i) for i in range(env.num_envs)]
    env.reset(scenarios)
    policy.reset(env, scenarios)
    total = np.zeros(env.num_envs)
    while not env.done.all():
        result = env.step(policy.act(env))
        total += result.reward
    return float(result.success.mean()), float(total.mean())


@pytest.mark.parametrize("task", ["ball", "wall", pytest.param("arch", marks=pytest.mark.slow)])
def test_the_oracle_solves_what_holding_still_does_not(env: VectorEnv, task: str) -> None:
    held, held_return = outcome(env, Hold(), task)
    solved, solved_return = outcome(env, Oracle(), task)
    assert solved > held
    assert solved_return > held_return
    assert solved >= 0.75


def test_oracles_act_inside_the_box(env: VectorEnv) -> None:
    env.reset([Scenario("ball", 0, i) for i in range(4)])
    oracle = Oracle()
    for _ in range(20):
        action = oracle.act(env)
        assert action.shape == (4, ACTION_DIM)
        assert np.abs(action).max() <= 1.0
        env.step(action)
