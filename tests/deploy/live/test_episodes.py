"""Several episodes of the fake robot in one run: it is hung up in between, and none of it damps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.plan import PolicyStep
from egovcp.rate import LockstepClock
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.live import LiveRobot, Phase
from egovcp.sim.scenario import Scenario
from egovcp_deploy.live.control import ControlLoop, Wishes
from egovcp_deploy.live.operators import Auto
from egovcp_deploy.live.process import RemoteKeys
from egovcp_deploy.pilot.desk import InlineDesk, Thinker
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.states import Limits, State
from egovcp_deploy.robots.fake.episodes import EpisodeSchedule, EpisodeSequencer
from tests.support.robots.sim_low_level import SimLowLevelRobot

from .conftest import TICK_NS, Reaching


class Crouching(Reaching):
    """Wants the pelvis as low as it goes."""

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        step = super().act(depth, state, remaining)
        step.plan[..., -1] = -1.0
        return step


@pytest.mark.parametrize("name", ["stance", "walk"])
@pytest.mark.parametrize("pause", [0.0, 2.0])
def test_a_planner_that_goes_on_meets_the_next_episode_standing(name: str, pause: float) -> None:
    quiet = EpisodeConfig(ticks=50, event_ticks=(5, 5), empty_probability=1.0)
    robot = LiveRobot(EnvConfig(controller=name, ball_episode=quiet))
    robot.start(Scenario("ball", 0, 0))
    body = SimLowLevelRobot(robot)
    episodes = EpisodeSequencer(
        body, lambda n: Scenario("ball", 0, n) if n < 3 else None, EpisodeSchedule(pause=pause)
    )
    clock, controller = LockstepClock(), make_controller(name)
    desk = InlineDesk(Thinker(Crouching()), clock)
    loop = ControlLoop(body, body.camera, controller, Pilot(desk, Limits()))
    operator, remote = Auto((0.0, 0.0, 0.0), 0.0), RemoteKeys()
    seen: set[tuple[Phase, State]] = set()
    for _ in range(2500):
        orders = [*operator.orders(clock.now_ns(), loop.state), *remote.orders(body)]
        requests = [order.request for order in orders if order.request is not None]
        loop.tick(clock.now_ns(), Wishes(requests[-1] if requests else None))
        seen.add((robot.phase, loop.state))
        for _ in range(4):
            episodes.step()
        clock.advance(TICK_NS)
        if episodes.finished:
            break
    assert [outcome.fallen for outcome in episodes.outcomes] == [False] * 3
    assert State.DAMP not in {state for _, state in seen}
    assert {state for phase, state in seen if phase is Phase.EPISODE} == {State.RUN}
