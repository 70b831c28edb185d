"""The simulator as PPO sees it, and PPO: episodes, images, time limits, and that it learns."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from egovcp import spec
from egovcp.reactive import ReactiveConfig
from egovcp.sim.base_env import Observation, StepResult
from egovcp.sim.config import EnvConfig
from egovcp.sim.scenario import Scenario
from egovcp_train.ppo.learner import ContactEnv, ContactLearner
from egovcp_train.ppo.train import PpoTrainConfig

LIMIT = 4
TINY = ReactiveConfig(frames=2, channels=(2, 2, 2), hidden=(16,))
type Build = Callable[..., ContactEnv]


class _Fake:
    """Episodes of ``LIMIT`` ticks that end in a fall after two where the episode is number 1; a
    depth image is as far away, in m, as ticks have passed, plus 1; a reward is the first
    coordinate."""

    controller = SimpleNamespace(id="fake")

    def __init__(self, config: EnvConfig, robots: int) -> None:
        self.instances: list[Any] = []
        self._ticks = np.zeros(robots, dtype=np.int64)

    def reset(self, scenarios: Sequence[Scenario]) -> Observation:
        self.instances = [SimpleNamespace(scenario=s) for s in scenarios]
        return self._observe()

    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> Observation:
        for row, scenario in zip(rows, scenarios, strict=True):
            self.instances[row] = SimpleNamespace(scenario=scenario)
            self._ticks[row] = 0
        return self._observe()

    def step(self, action: NDArray[np.floating]) -> StepResult:
        self._ticks += 1
        falls = np.array([lane.scenario.episode == 1 for lane in self.instances])
        fallen = falls & (self._ticks == 2)
        late = self._ticks == LIMIT
        reward = action[:, 0].astype(np.float64)
        return StepResult(
            self._observe(), reward, {}, fallen, late, late, action, ({},) * len(late)
        )

    def _observe(self) -> Observation:
        depth = 1000 * (1 + self._ticks[:, None, None])
        shape = (len(self._ticks), spec.DEPTH_ROWS, spec.DEPTH_COLS)
        state = np.zeros((len(self._ticks), spec.STATE_DIM), np.float32)
        return Observation(np.broadcast_to(depth, shape).astype(np.uint16), state)

    def close(self) -> None:
        pass


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("egovcp_train.ppo.learner.VectorEnv", _Fake)


@pytest.fixture
def build() -> Build:
    def env(
        robots: int = 2, tasks: Sequence[str] = ("ball",), first_episode: int = 0
    ) -> ContactEnv:
        return ContactEnv(EnvConfig(), tasks, robots, TINY, seed=5, first_episode=first_episode)

    return env


def _playing(env: ContactEnv) -> list[tuple[str, int, int]]:
    found = [lane.scenario for lane in env.env.instances]
    return [(s.task, s.seed, s.episode) for s in found]


def _step(env: ContactEnv, x: float = 0.0) -> tuple[Any, ...]:
    return env.step(torch.full((env.num_envs, spec.ACTION_DIM), x))


def test_a_robot_whose_episode_is_over_begins_the_next_at_once(build: Build) -> None:
    env = build()
    assert _playing(env) == [("ball", 5, 0), ("ball", 5, 1)]
    _step(env)
    _, _, done, _ = _step(env)
    assert done.tolist() == [0.0, 1.0]
    assert _playing(env) == [("ball", 5, 0), ("ball", 5, 2)]
    assert env.episode_length_buf.tolist() == [2, 0]
    assert env.episodes == 3


def test_tasks_take_turns_and_each_counts_its_own_episodes(build: Build) -> None:
    assert _playing(build(4, ("ball", "wall"))) == [
        ("ball", 5, 0),
        ("wall", 5, 0),
        ("ball", 5, 1),
        ("wall", 5, 1),
    ]
    assert _playing(build(2, ("ball", "wall"), first_episode=7)) == [("wall", 5, 3), ("ball", 5, 4)]


def test_a_time_limit_is_no_failure(build: Build) -> None:
    env = build()
    ends = []
    for _ in range(LIMIT):
        _, _, done, extras = _step(env)
        ends.append((done.tolist(), extras["time_outs"].tolist()))
    assert ends[1] == ([0.0, 1.0], [False, False])
    assert ends[3] == ([1.0, 0.0], [True, False])


def test_images_of_an_episode_never_reach_into_the_next(build: Build) -> None:
    env = build()
    _step(env)
    obs, *_ = _step(env)
    near = obs["depth"].mean((-2, -1))
    unit = 1 / spec.DEPTH_MAX_M
    expected = 1 - unit * torch.tensor([[3.0, 2.0], [1.0, 1.0]])
    torch.testing.assert_close(near, expected)


def test_returns_are_those_of_whole_episodes(build: Build) -> None:
    env = build()
    _step(env, 0.5)
    *_, extras = _step(env, 3.0)  # limited to the box
    assert dict(extras["log"]) == {
        "ball/return": [1.5],
        "ball/success": [0.0],
        "ball/ticks": [2.0],
    }


@pytest.mark.slow
def test_it_learns_what_is_rewarded_and_exports_what_it_learned() -> None:
    torch.manual_seed(0)
    ppo = replace(PpoTrainConfig("").ppo, num_steps_per_env=8, learning_rate=3e-3, desired_kl=0.05)
    config = PpoTrainConfig("unused", robots=8, network=TINY, ppo=ppo, initial_std=0.2)
    learner = ContactLearner(config)
    rewards = [learner.iterate()["reward"] for _ in range(25)]
    assert abs(rewards[0]) < 0.2  # it begins in the neutral pose
    assert rewards[-1] > 0.4
    assert learner.steps == 25 * 8 * 8
    obs = learner.env.get_observations()
    learner.ppo.eval_mode()
    with torch.no_grad():
        expected = learner.ppo.get_policy()(obs).clamp(-1.0, 1.0)
    found = learner.policy({})(obs["depth"], obs["state"])
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
