"""A fake robot behind real sockets, with its time in the hands of the test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.live import LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp_deploy.robots.bridge import BridgeBody
from egovcp_deploy.robots.fake import FakeBridge, Ports
from egovcp_deploy.robots.fake.running import PATIENCE_S, Running, config_of

SHORT = EpisodeConfig(ticks=20, event_ticks=(3, 4), empty_probability=0.0)


@pytest.fixture(scope="session")
def live() -> LiveRobot:
    return LiveRobot(EnvConfig(controller="stance", ball_episode=SHORT, wall_episode=SHORT))


@pytest.fixture
def fake(live: LiveRobot) -> Iterator[FakeBridge]:
    """On the crane; nothing moves until somebody steps it."""
    live.start(Scenario("ball", 0, 0))
    bridge = FakeBridge(live, Ports(command_port=0, state_port=0, camera_port=0))
    yield bridge
    bridge.close()


@pytest.fixture
def running(fake: FakeBridge) -> Iterator[Running]:
    time_passes = Running(fake)
    yield time_passes
    time_passes.stop()


@pytest.fixture
def body(running: Running) -> Iterator[BridgeBody]:
    """Connected to the running fake."""
    found = BridgeBody(config_of(running.fake))
    found.connect(PATIENCE_S)
    yield found
    found.close()
