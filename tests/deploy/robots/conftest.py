"""A fake G1 on real sockets."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.live import LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.wall import WallConfig
from egovcp_deploy.robots.bridge import BridgeRobot
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from tests.support.robots.fake_g1 import TIMEOUT_S, FakeG1Thread, bridge_config

SHORT = EpisodeConfig(ticks=20, event_ticks=(3, 4), empty_probability=0.0)


@pytest.fixture(scope="session")
def live() -> LiveRobot:
    gentle = WallConfig(push_speed_range=(0.3, 0.4))  # the controller does not step
    config = EnvConfig(controller="stance", ball_episode=SHORT, wall_episode=SHORT, wall=gentle)
    return LiveRobot(config)


@pytest.fixture
def fake(live: LiveRobot) -> Iterator[FakeBridge]:
    """On the gantry; advances only when a test steps it."""
    live.start(Scenario("ball", 0, 0))
    bridge = FakeBridge(live, Ports(command_port=0, state_port=0, camera_port=0))
    yield bridge
    bridge.close()


@pytest.fixture
def running(fake: FakeBridge) -> Iterator[FakeG1Thread]:
    thread = FakeG1Thread(fake)
    yield thread
    thread.stop()


@pytest.fixture
def robot(running: FakeG1Thread) -> Iterator[BridgeRobot]:
    """Connected to the running fake."""
    found = BridgeRobot(bridge_config(running.fake))
    found.connect(TIMEOUT_S)
    yield found
    found.close()
