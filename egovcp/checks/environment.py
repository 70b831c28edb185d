"""Conformance check of a vectorised environment: clock, reset, limits, repeatability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.errors import ConformanceError
from egovcp.robot_spec import G1, RobotSpec

if TYPE_CHECKING:
    from egovcp.sim.base_env import BaseVectorEnv, Observation, StepResult
    from egovcp.sim.scenario import Scenario

COMMAND_TOLERANCE = 1e-4  # m; float32 rounding of a command

type Array = NDArray[np.floating]


def check_env(env: BaseVectorEnv, scenarios: Sequence[Scenario], ticks: int = 20) -> None:
    """Run the scenarios twice under the same random actions and check every tick.

    ``scenarios`` has one per row of the environment; the actions exceed the rate limit. Raises
    `ConformanceError`, which names the tick and the property. The robot is the G1, or that of
    ``env.robot``.
    """
    robot: RobotSpec = getattr(env, "robot", G1)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (ticks, env.num_envs, robot.action_dim))
    first, second = (_run_actions(env, scenarios, actions, robot) for _ in range(2))
    for t, (a, b) in enumerate(zip(first, second, strict=True)):
        for name in a:
            if not np.array_equal(a[name], b[name]):
                raise ConformanceError(
                    f"environment, tick {t}: {name} differs between two runs with the same "
                    "actions; draw random numbers from the scenario only"
                )


def _run_actions(
    env: BaseVectorEnv, scenarios: Sequence[Scenario], actions: Array, robot: RobotSpec
) -> list[dict[str, NDArray[np.generic]]]:
    """Observation and reward of each tick; tick 0 is the reset."""
    sent: Array = np.zeros((env.num_envs, robot.action_dim))
    finished: NDArray[np.bool_] = np.zeros(env.num_envs, dtype=np.bool_)
    observation = env.reset(scenarios)
    _check_observation(observation, sent, 0, robot)
    history: list[dict[str, NDArray[np.generic]]] = [_arrays(observation)]
    for t, action in enumerate(actions, start=1):
        step = env.step(action)
        _check_step(step, finished, t)
        _check_sent(step.sent_action, sent, t)
        _check_observation(step.observation, step.sent_action, t, robot)
        history.append(_arrays(step.observation) | {"reward": np.array(step.reward)})
        sent, finished = np.array(step.sent_action), step.terminated | step.truncated
    return history


def _arrays(observation: Observation) -> dict[str, NDArray[np.generic]]:
    return {"depth": observation.depth.copy(), "state": observation.state.copy()}


def _check_observation(observation: Observation, sent: Array, t: int, robot: RobotSpec) -> None:
    depth, state, rows = observation.depth, observation.state, len(sent)
    layout: dict[str, tuple[NDArray[Any], tuple[int, ...], type[np.generic]]] = {
        "depth": (depth, (rows, *robot.depth), np.uint16),
        "state": (state, (rows, robot.state_dim), np.float32),
    }
    for name, (array, shape, dtype) in layout.items():
        found, expected = f"{array.dtype} {array.shape}", f"{np.dtype(dtype)} {shape}"
        _require(found == expected, t, f"{name} is {found}, expected {expected}")
    _require(np.isfinite(state).all(), t, "state is not finite")
    near = depth <= 1000 * robot.depth_max_m
    _require(near.all(), t, f"depth exceeds {robot.depth_max_m} m")
    if not robot.is_g1:
        return  # its state need not hold the command
    off = np.abs(command_from_state(state) - spec.ACTION_BOX.to_metric(sent)).max()
    problem = f"the command in the state is not the last one sent (off by {off:.3g} m)"
    _require(off <= COMMAND_TOLERANCE, t, problem)


def _check_sent(sent: Array, before: Array, t: int) -> None:
    change, limit = np.abs(sent - before).max(), spec.ACTION_RATE_LIMIT
    _require(
        change <= limit + 1e-6,
        t,
        f"the action sent changed by {change:.3g} (normalised units) in one tick, above the rate "
        f"limit of {limit}; limit it in step",
    )
    _require(np.abs(sent).max() <= 1 + 1e-6, t, "the action sent leaves [-1, 1]; clip it in step")


def _check_step(step: StepResult, finished: NDArray[np.bool_], t: int) -> None:
    terms = np.sum(list(step.reward_terms.values()), axis=0)
    done = step.terminated | step.truncated
    both = step.terminated & step.truncated
    _require(np.isfinite(step.reward).all(), t, "reward is not finite")
    _require(np.allclose(terms, step.reward), t, "reward is not the sum of its terms")
    _require(not both.any(), t, "a row is terminated and truncated at once")
    _require(done[finished].all(), t, "an episode continues after its end")
    late = np.flatnonzero(finished & (step.reward != 0))
    problem = f"rewards {step.reward[late]} in rows {late} after the end of their episodes"
    _require(not len(late), t, f"{problem}; expected 0")


def _require(ok: bool | np.bool_, t: int, problem: str) -> None:
    if not ok:
        raise ConformanceError(f"environment, tick {t}: {problem}")


def command_from_state(state: NDArray[np.floating]) -> NDArray[np.floating]:
    """(..., 74) state -> (..., 7) commanded hands and height, metres."""
    hands, height = spec.STATE_SLICES["command_hands"], spec.STATE_SLICES["command_height"]
    return state[..., hands.start : height.stop]
