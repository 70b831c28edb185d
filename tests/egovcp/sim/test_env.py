"""The vectorised environment and its Gymnasium interface."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from egovcp.errors import UsageError
from egovcp.sim.base_env import StepResult
from egovcp.sim.config import DelayConfig, EnvConfig, EpisodeConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.gym import EgovcpEnv, register
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp.spec import (
    ACTION_BOX,
    ACTION_DIM,
    ACTION_RATE_LIMIT,
    COMMAND_SLICE,
    DEPTH_COLS,
    DEPTH_ROWS,
    REWARD_TERMS,
    STATE_DIM,
    STATE_SLICES,
)


def scenarios(task: str, n: int, first: int = 0) -> list[Scenario]:
    return [Scenario(task, 1, first + i) for i in range(n)]


def roll(env: VectorEnv, which: list[Scenario], ticks: int) -> list[StepResult]:
    """A random walk in every row."""
    walk = RandomWalk()
    env.reset(which)
    walk.reset(env, which)
    return [env.step(walk.act(env)) for _ in range(ticks)]


def assert_same_row(a: StepResult, i: int, b: StepResult, j: int) -> None:
    np.testing.assert_array_equal(a.observation.depth[i], b.observation.depth[j])
    np.testing.assert_array_equal(a.observation.state[i], b.observation.state[j])
    assert a.reward[i] == b.reward[j]
    assert a.success[i] == b.success[j]


def test_shapes_and_types(env: VectorEnv) -> None:
    observation = env.reset(scenarios("ball", 4))
    assert observation.depth.shape == (4, DEPTH_ROWS, DEPTH_COLS)
    assert observation.depth.dtype == np.uint16
    assert observation.state.shape == (4, STATE_DIM)
    assert observation.state.dtype == np.float32


@pytest.mark.parametrize(
    "task",
    ["wall", "sequence", *(pytest.param(t, marks=pytest.mark.slow) for t in ("ball", "arch"))],
)
def test_an_episode_repeats_bit_for_bit_with_any_neighbours(
    env: VectorEnv, config: EnvConfig, task: str
) -> None:
    first = roll(env, scenarios(task, 4), 20)
    alone = VectorEnv(config, 1)
    second = roll(alone, [Scenario(task, 1, 2)], 20)
    for a, b in zip(first, second, strict=True):
        assert_same_row(a, 2, b, 0)


@pytest.mark.parametrize(
    "task", [pytest.param("ball", marks=pytest.mark.slow), "wall"]
)  # before a wall every ray is cast
def test_threads_change_nothing(env: VectorEnv, config: EnvConfig, task: str) -> None:
    threaded = VectorEnv(replace(config, threads=2), 4)
    pairs = zip(
        roll(env, scenarios(task, 4), 15), roll(threaded, scenarios(task, 4), 15), strict=True
    )
    for a, b in pairs:
        for row in range(4):
            assert_same_row(a, row, b, row)
    threaded.close()


def test_tasks_may_be_mixed_in_a_batch(env: VectorEnv) -> None:
    mixed = [Scenario(task, 1, 0) for task in ("ball", "wall", "arch", "sequence")]
    together = roll(env, mixed, 12)[-1]
    assert set(together.reward_terms) == set(REWARD_TERMS)
    assert together.parts == ({}, {}, {}, {"arch": False, "ball": False, "wall": False})
    apart = roll(env, [Scenario("wall", 1, i) for i in range(4)], 12)[-1]
    np.testing.assert_array_equal(together.observation.state[1], apart.observation.state[0])


def test_reset_rows_starts_some_and_leaves_the_others(env: VectorEnv) -> None:
    undisturbed = roll(env, scenarios("ball", 4), 12)
    walk = RandomWalk()
    env.reset(scenarios("ball", 4))
    walk.reset(env, scenarios("ball", 4))
    for t in range(12):
        if t == 6:
            env.reset_rows([1], [Scenario("ball", 9, 9)])
        result = env.step(walk.act(env))
    for row in (0, 2, 3):
        assert_same_row(result, row, undisturbed[-1], row)
    assert env.tick.tolist() == [12, 6, 12, 12]


def test_reward_is_the_sum_of_its_terms(env: VectorEnv) -> None:
    for result in roll(env, scenarios("wall", 4), 30):
        total = np.sum(list(result.reward_terms.values()), axis=0)
        np.testing.assert_allclose(result.reward, total)


def test_sent_actions_obey_rate_limit_and_box(env: VectorEnv) -> None:
    env.reset(scenarios("ball", 4))
    last = np.zeros((4, ACTION_DIM))
    for sign in (1, 1, 1, 1, -1):
        sent = env.step(np.full((4, ACTION_DIM), 5.0 * sign)).sent_action
        assert np.abs(sent - last).max() <= ACTION_RATE_LIMIT + 1e-12
        assert np.abs(sent).max() <= 1.0
        last = sent
    assert np.all(last == 1.0 - ACTION_RATE_LIMIT)


def test_the_observed_command_is_the_one_last_sent(env: VectorEnv) -> None:
    env.reset(scenarios("ball", 4))
    result = env.step(np.full((4, ACTION_DIM), 0.3))
    command = result.observation.state[:, COMMAND_SLICE]
    np.testing.assert_allclose(command[:, 3:], ACTION_BOX.to_metric(result.sent_action), atol=1e-6)
    np.testing.assert_array_equal(command[:, :3], 0.0)


def test_the_arch_commands_its_speed_from_the_event_on(env: VectorEnv) -> None:
    results = roll(env, scenarios("arch", 4), 8)
    speed = [p["speed"] for p in env.parameters]
    vx = results[-1].observation.state[:, STATE_SLICES["command_velocity"]][:, 0]
    np.testing.assert_allclose(vx, speed, atol=1e-6)


class Recorder:
    """Wraps a controller and records its observations."""

    def __init__(self, inner: VectorEnv) -> None:
        self._inner = inner.controller
        self.id, self.walks = "recorder", True
        self.heights: list[float] = []

    def reset(self, state: np.ndarray, rows: np.ndarray | None = None) -> None:
        self._inner.reset(state, rows)

    def step(self, state: np.ndarray) -> np.ndarray:
        self.heights.append(float(state[0, STATE_SLICES["command_height"]][0]))
        return self._inner.step(state)


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_an_action_takes_effect_after_its_delay(
    env: VectorEnv, config: EnvConfig, delay: int
) -> None:
    late = replace(config, delay=DelayConfig(action_ticks=(delay, delay)))
    recorder = Recorder(env)
    one = VectorEnv(late, 1, recorder)
    one.reset(scenarios("ball", 1))
    recorder.heights.clear()
    for height in (0.1, 0.2, 0.3):
        one.step(np.array([[0, 0, 0, 0, 0, 0, height]]))
    metric = [ACTION_BOX.to_metric(np.array([0, 0, 0, 0, 0, 0, h]))[6] for h in (0, 0.1, 0.2, 0.3)]
    ticks = np.repeat(metric, [delay, 2, 2, 2])[:6]
    np.testing.assert_allclose(recorder.heights, ticks)


@pytest.mark.parametrize(("age", "ticks"), [(0.02, 0), (0.04, 1), (0.06, 1), (0.08, 2), (0.2, 5)])
def test_a_depth_image_has_the_configured_age(config: EnvConfig, age: float, ticks: int) -> None:
    quiet = replace(
        config.camera,
        noise_per_z2=(0.0, 0.0),
        hole_probability=(0.0, 0.0),
        edge_probability=(0.0, 0.0),
    )
    still = replace(config, controller="stance", camera=quiet)  # `walk` sways, and so the image
    late = replace(still, delay=DelayConfig(image_age=(age, age)))
    env = VectorEnv(late, 1)
    before = env.reset(scenarios("ball", 1)).depth[0].astype(int)
    seen = []
    for _ in range(14):
        event = env.instances[0].task.since_event
        now = env.step(np.zeros((1, ACTION_DIM))).observation.depth[0].astype(int)
        if np.any((now > 1500) & (now < 3600) & (np.abs(now - before) > 400)):
            seen.append(event)
    # thrown as its tick begins: a picture 40 ms old at that tick's end still shows nothing
    assert seen[0] == pytest.approx(ticks * 0.04)


def test_time_limit_truncates_and_then_the_row_stands_still(config: EnvConfig) -> None:
    brief = replace(config, ball_episode=EpisodeConfig(3, (0, 0), 1.0))
    env = VectorEnv(brief, 2)
    results = roll(env, scenarios("ball", 2), 5)
    assert [r.truncated.tolist() for r in results[1:4]] == [[False] * 2, [True] * 2, [True] * 2]
    assert not results[-1].terminated.any()
    assert results[-1].success.all()
    assert not results[-1].reward.any()
    np.testing.assert_array_equal(results[-1].observation.state, results[2].observation.state)


def test_a_toppled_robot_terminates(env: VectorEnv) -> None:
    env.reset(scenarios("ball", 4))
    env.instances[0].robot.data.qvel[0] = 4.0
    for _ in range(30):
        result = env.step(np.zeros((4, ACTION_DIM)))
    assert result.terminated.tolist() == [True, False, False, False]
    assert not result.truncated[0]
    assert not result.success[0]


@pytest.mark.parametrize(
    ("action", "match"),
    [(np.zeros((4, 6)), "shape"), (np.full((4, 7), np.nan), "finite")],
)
def test_bad_actions_are_refused(env: VectorEnv, action: np.ndarray, match: str) -> None:
    env.reset(scenarios("ball", 4))
    with pytest.raises(UsageError, match=match):
        env.step(action)


def test_wrong_number_of_scenarios_is_refused(env: VectorEnv) -> None:
    with pytest.raises(UsageError, match="expected 4 scenarios, found 3"):
        env.reset(scenarios("ball", 3))


def test_physics_differs_between_episodes_and_is_recorded(env: VectorEnv) -> None:
    env.reset(scenarios("ball", 4))
    assert len({p["friction"] for p in env.parameters}) == 4
    mass = [lane.robot.model.body_subtreemass[1] for lane in env.instances]
    assert len(set(mass)) == 4


@pytest.fixture(scope="module")
def gym_env(config: EnvConfig) -> EgovcpEnv:
    return EgovcpEnv("ball", config)


@pytest.mark.filterwarnings("ignore:.*Box observation space.*")
def test_gymnasium_check_env_passes(gym_env: EgovcpEnv) -> None:
    check_env(gym_env, skip_render_check=True)


def test_registered_names_make_the_environment() -> None:
    register()
    register()
    assert gymnasium.spec("egovcp/wall-v0").kwargs == {"task": "wall"}


def test_reset_with_seed_starts_episode_zero_and_without_the_next(gym_env: EgovcpEnv) -> None:
    first, info = gym_env.reset(seed=4)
    second, next_info = gym_env.reset()
    again, _ = gym_env.reset(seed=4)
    assert (info["episode"], next_info["episode"]) == (0, 1)
    np.testing.assert_array_equal(first["state"], again["state"])
    assert not np.array_equal(first["state"], second["state"])


def test_info_names_success_action_and_reward_terms(gym_env: EgovcpEnv) -> None:
    gym_env.reset(seed=0)
    _, reward, _, _, info = gym_env.step(np.full(7, 0.1, dtype=np.float32))
    assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert info["success"] is False
    np.testing.assert_allclose(info["sent_action"], 0.1)
