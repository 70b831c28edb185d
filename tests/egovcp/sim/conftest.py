"""Small batches and short episodes, shared by the simulator's tests."""

from __future__ import annotations

import pytest

from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.tasks.arch import ArchConfig

SOON = EpisodeConfig(ticks=45, event_ticks=(3, 6), empty_probability=0.0)


@pytest.fixture(scope="session")
def config() -> EnvConfig:
    """Episodes in which the event comes soon."""
    return EnvConfig(
        arch=ArchConfig(distance_range=(0.9, 1.0)),
        ball_episode=SOON,
        wall_episode=SOON,
        arch_episode=EpisodeConfig(ticks=115, event_ticks=(3, 6), empty_probability=0.0),
    )


@pytest.fixture(scope="session")
def env(config: EnvConfig) -> VectorEnv:
    """Four robots; every test resets them."""
    return VectorEnv(config, 4)
