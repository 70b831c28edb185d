"""What the scenes leave to the low-level controller, and the shipped one in them."""

from dataclasses import replace

import numpy as np
import pytest

from egovcp.errors import UsageError
from egovcp.sim.config import (
    STANDING_PUSHES,
    STEPPING_PUSHES,
    ArchConfig,
    EnvConfig,
    EpisodeConfig,
    WallConfig,
)
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import EnvPolicy, Hold, Oracle
from egovcp.sim.scenario import Scenario


def test_arch_motion_depends_on_the_controller():
    assert VectorEnv(EnvConfig(), 1).config.arch.motion == "walk"
    assert VectorEnv(EnvConfig(controller="stance"), 1).config.arch.motion == "rail"


def test_pushes_are_those_of_the_controller_unless_given():
    assert EnvConfig().for_controller(walks=True).wall.push_speed_range == STEPPING_PUSHES
    assert EnvConfig().for_controller(walks=False).wall.push_speed_range == STANDING_PUSHES
    given = EnvConfig(wall=WallConfig(push_speed_range=(0.1, 0.2)))
    assert given.for_controller(walks=True).wall.push_speed_range == (0.1, 0.2)


def test_a_brace_is_rewarded_for_as_long_as_the_controller_needs_it():
    assert EnvConfig().for_controller(walks=True).wall.disturbed_time == 2.0
    assert EnvConfig().for_controller(walks=False).wall.disturbed_time == 6.0
    given = EnvConfig(wall=WallConfig(disturbed_time=1.0))
    assert given.for_controller(walks=False).wall.disturbed_time == 1.0


def test_only_stepping_controllers_release_the_wall():
    """Two seconds after a push the oracle takes its hands off: who does not step falls forward."""
    held = EpisodeConfig(ticks=140, event_ticks=(3, 6), empty_probability=0.0)
    for controller, stands in (("walk", 8), ("stance", 0)):
        wall = WallConfig(away_probability=0.0, disturbed_time=2.0)
        config = EnvConfig(controller=controller, wall=wall, wall_episode=held)
        succeeded, _ = _play(config, "wall", Oracle(), rows=8)
        assert sum(succeeded) == stands


def test_a_robot_that_walks_is_not_put_before_an_arch_on_a_rail():
    with pytest.raises(UsageError, match=r"arch\.motion=rail.*walks.*--env\.controller"):
        VectorEnv(EnvConfig(arch=ArchConfig(motion="rail")), 1)


def _play(
    config: EnvConfig, task: str, policy: EnvPolicy, rows: int
) -> tuple[list[bool], list[bool]]:
    env = VectorEnv(config, rows)
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
    assert _play(soon, "arch", Oracle(), 3) == ([True] * 3, [False] * 3)
    low = replace(soon, arch=replace(soon.arch, clearance_range=(1.08, 1.12)))
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
    nothing = EpisodeConfig(ticks=150, empty_probability=1.0)
    env = VectorEnv(EnvConfig(controller=controller, ball_episode=nothing), 32, render_depth=False)
    env.reset([Scenario("ball", 0, i) for i in range(32)])
    rng = np.random.default_rng(0)
    corner, left = np.zeros((32, 7)), np.zeros(32, int)
    fallen = np.zeros(32, bool)
    while not env.done.all():
        new = left <= 0
        corner[new] = rng.choice([-1.0, 1.0], (new.sum(), 7))
        left[new] = rng.integers(2, 8, new.sum())
        left -= 1
        fallen |= env.step(corner).terminated
    assert not fallen.any()
