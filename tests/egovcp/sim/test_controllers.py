"""The shipped low-level controller in the scenes."""

from dataclasses import replace

import numpy as np
import pytest

from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import EnvPolicy, Hold, Oracle
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.arch import ArchConfig
from egovcp.sim.tasks.wall import WallConfig


def test_two_seconds_after_the_push_the_oracle_stands_with_free_hands():
    timing = EpisodeConfig(ticks=100, event_ticks=(3, 6), empty_probability=0.0)
    config = EnvConfig(wall=WallConfig(away_probability=0.0), wall_episode=timing)
    succeeded, fallen = _play(config, "wall", Oracle(), rows=8)
    assert sum(succeeded) >= 7
    assert not any(fallen)


def _play(
    config: EnvConfig, task: str, policy: EnvPolicy, rows: int
) -> tuple[list[bool], list[bool]]:
    env = VectorEnv(config, rows, render_depth=False)
    scenarios = [Scenario(task, 5, i) for i in range(rows)]
    env.reset(scenarios)
    policy.reset(env, scenarios)
    while not env.done.all():
        result = env.step(policy.act(env))
    return result.success.tolist(), result.terminated.tolist()


@pytest.fixture(scope="module")
def soon() -> EnvConfig:
    """The shipped controller, and events that come soon."""
    early = {"event_ticks": (3, 6), "empty_probability": 0.0}
    return EnvConfig(
        arch=ArchConfig(distance_range=(0.9, 1.0), speed_range=(0.4, 0.5)),
        wall=WallConfig(away_probability=0.0),
        wall_episode=EpisodeConfig(ticks=60, **early),
        arch_episode=EpisodeConfig(ticks=150, **early),
    )


def test_the_oracle_walks_under_the_arch_and_an_upright_robot_into_it(soon: EnvConfig):
    assert _play(soon, "arch", Oracle(), 2) == ([True] * 2, [False] * 2)
    low = replace(soon, arch=replace(soon.arch, clearance_range=(1.08, 1.12)))
    assert _play(low, "arch", Oracle(), 2) == ([True] * 2, [False] * 2)
    success, _ = _play(low, "arch", Hold(), 2)
    assert not any(success)


def test_hands_brace_what_stepping_does_not(soon: EnvConfig):
    braced, _ = _play(soon, "wall", Oracle(), 4)
    at_rest, _ = _play(soon, "wall", Hold(), 4)
    assert np.mean(braced) >= 0.75
    assert np.mean(at_rest) <= 0.25


@pytest.mark.parametrize("controller", ["stance", "walk"])
def test_no_robot_falls_under_extreme_command_changes(controller: str):
    """A new corner of the box every 2 to 7 ticks; squats of 0.45 m/s made 6 of 32 robots fall."""
    nothing = EpisodeConfig(ticks=100, empty_probability=1.0)
    env = VectorEnv(EnvConfig(controller=controller, ball_episode=nothing), 16, render_depth=False)
    env.reset([Scenario("ball", 0, i) for i in range(16)])
    rng = np.random.default_rng(0)
    corner, left = np.zeros((16, 7)), np.zeros(16, int)
    fallen = np.zeros(16, bool)
    while not env.done.all():
        new = left <= 0
        corner[new] = rng.choice([-1.0, 1.0], (new.sum(), 7))
        left[new] = rng.integers(2, 8, new.sum())
        left -= 1
        fallen |= env.step(corner).terminated
    assert not fallen.any()
