"""A simulation that leaves the range of real robots is an error, never an episode."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egovcp.errors import SimulationDiverged
from egovcp.sim.config import EnvConfig, RandomisationConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.live import LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM

SCENARIOS = [Scenario("ball", 7, number) for number in range(4)]
NO_ACTION = np.zeros((4, ACTION_DIM))


def roll(env: VectorEnv, ticks: int) -> None:
    for _ in range(ticks):
        env.step(NO_ACTION)


@pytest.mark.parametrize(
    ("array", "index", "value", "found"),
    [
        ("qvel", 10, np.nan, "velocity of .*_joint is not finite or huge .mjWARN_BADQVEL."),
        ("qvel", 10, 1e12, "velocity of .*_joint is not finite or huge .mjWARN_BADQVEL."),
        ("qvel", 0, 3e3, "(velocity|acceleration) of floating_base_joint is"),
        ("qpos", 20, np.nan, "a position is not finite or huge .mjWARN_BADQPOS."),
    ],
)
def test_error_names_scenario_and_what_diverged(
    env: VectorEnv,
    array: str,
    index: int,
    value: float,
    found: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    env.reset(SCENARIOS)
    env.step(NO_ACTION)
    getattr(env.instances[1].robot.data, array)[index] = value
    with pytest.raises(SimulationDiverged, match=found) as caught:
        env.step(NO_ACTION)
    assert "task ball, seed 7, episode 1, after 0.0" in str(caught.value)
    assert "radius=0." in str(caught.value)
    assert caught.value.exit_code == 3
    assert list(tmp_path.iterdir()) == []  # MuJoCo writes no MUJOCO_LOG.TXT


def test_targets_that_are_not_finite_are_named(env: VectorEnv) -> None:
    env.reset(SCENARIOS)
    with pytest.raises(SimulationDiverged, match="a joint target is not finite"):
        env.instances[0].advance(np.full(29, np.nan))


def test_next_episode_of_the_same_robot_is_valid_again(env: VectorEnv) -> None:
    env.reset(SCENARIOS)
    env.instances[1].robot.data.qvel[10] = np.nan
    with pytest.raises(SimulationDiverged):
        env.step(NO_ACTION)
    env.reset(SCENARIOS)
    assert np.isfinite(env.step(NO_ACTION).observation.state).all()


def test_scene_that_cannot_be_simulated_diverges(config: EnvConfig) -> None:
    heavy = replace(
        config.ball, radius_range=(0.01, 0.01), mass_range=(10, 10), flight_range=(0.2, 0.2)
    )
    env = VectorEnv(replace(config, ball=heavy), 4, render_depth=False)
    env.reset([Scenario("ball", 0, number) for number in range(4)])
    with pytest.raises(SimulationDiverged) as caught:
        roll(env, 45)
    assert "task ball, seed 0, episode " in str(caught.value)
    assert "radius=0.01, mass=10" in str(caught.value)


def test_live_robot_diverges_before_and_during_the_episode(config: EnvConfig) -> None:
    still = RandomisationConfig(initial_joint=0.0)
    live = LiveRobot(replace(config, randomise=still))
    for begun in (False, True):
        live.start(SCENARIOS[2])
        if begun:
            live.begin()
        live.advance(4)
        live.robot.data.qvel[12] = np.inf
        with pytest.raises(SimulationDiverged, match="seed 7, episode 2"):
            live.advance(4)
