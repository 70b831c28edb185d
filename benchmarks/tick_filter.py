"""What a tick costs beside planning and logging: the recurrence takes the observation in, the state
machine judges, the safety filter has its word. Default model size, one robot, one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from tick_logging import percentiles

from egovcp.model import WorldModel, WorldModelConfig
from egovcp.plan import PlannerConfig, Policy, PolicyStep
from egovcp.rate import LockstepClock
from egovcp.spec import ACTION_DIM, PLANNER_HZ, STATE_DIM, STATE_SLICES
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.planner import InlinePlanner, PlannerRunner
from egovcp_deploy.pilot.states import Facts, State


class Unplanned:
    """A policy that costs nothing: what is measured is what surrounds it."""

    def reset(self) -> None: ...

    def observe(self, depth: np.ndarray, state: np.ndarray) -> None: ...

    def advance(self, sent: np.ndarray) -> None: ...

    def act(
        self,
        depth: np.ndarray,
        state: np.ndarray,
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """Neutral."""
        action = np.zeros((1, ACTION_DIM), np.float32)
        return PolicyStep(action)


_TICK_NS = 1_000_000_000 // PLANNER_HZ


def filter_figures(rounds: int) -> dict[str, object]:
    """Percentiles over ``rounds`` seconds of ticks, as fast as they go."""
    torch.set_num_threads(1)
    policy = Policy(WorldModel(WorldModelConfig()), PlannerConfig(), 1)
    clock = LockstepClock()
    pilot = Pilot(InlinePlanner(PlannerRunner(Unplanned()), clock), state=State.ARMED)
    rng = np.random.default_rng(0)
    observe, judge = list[float](), list[float]()
    for _ in range(rounds * PLANNER_HZ):
        depth, state = _observation(rng)
        begin = time.perf_counter()
        policy.observe(depth[None], state[None])
        policy.advance(np.zeros((1, ACTION_DIM)))
        filtered = time.perf_counter()
        pilot.sense(clock.now_ns(), state, depth)
        pilot.update_state(Facts(clock.now_ns()))
        pilot.send_observation(clock.now_ns(), depth, state)
        pilot.receive_plans(clock.now_ns())
        pilot.next_action()
        judge.append(time.perf_counter() - filtered)
        observe.append(filtered - begin)
        clock.advance(_TICK_NS)
    both = [a + b for a, b in zip(observe, judge, strict=True)]
    return {
        **percentiles("filter_observe", observe),
        **percentiles("filter_pilot", judge),
        **percentiles("filter", both),
    }


def _observation(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    depth = rng.integers(280, 5000, (48, 64)).astype(np.uint16)
    state = rng.normal(0, 0.01, STATE_DIM).astype(np.float32)
    state[STATE_SLICES["projected_gravity"].stop - 1] = -1.0
    return depth, state
