"""The vectorised environment: many robots, one controller call for all of them.

Time inside one planner tick t: the action is limited and sent, then twice: the command
that is due after the action delay goes to the controller (50 Hz, whole batch), and every
robot does four physics steps of 5 ms under the joint targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.robot.controller import LowLevelController
from egovcp.robot.controllers import absolute_controller, make_controller
from egovcp.sim.camera import DepthCamera
from egovcp.sim.config import EnvConfig
from egovcp.sim.lane import Lane
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import build_scene
from egovcp.sim.standing import settle
from egovcp.sim.truth import Truth, snapshot
from egovcp.spec import (
    ACTION_BOX,
    ACTION_DIM,
    ACTION_RATE_LIMIT,
    COMMAND_SLICE,
    CONTROLLER_TICKS_PER_PLAN,
    DEPTH_COLS,
    DEPTH_ROWS,
    STATE_DIM,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Observation:
    """What the robots measure at a planner tick."""

    depth: NDArray[np.uint16]
    """(B, H, W) planar depth, mm, 0 invalid."""
    state: NDArray[np.float32]
    """(B, S) proprioception in the layout of ``spec.STATE_SLICES``."""


@dataclass(frozen=True)
class StepResult:
    """What a planner tick brought. Rows whose episode is over repeat their last observation
    with zero reward."""

    observation: Observation
    reward: NDArray[np.float64]
    """(B,) sum of the terms."""
    reward_terms: dict[str, NDArray[np.float64]]
    """(B,) per name; 0 where a row's task lacks the term."""
    terminated: NDArray[np.bool_]
    """(B,) fallen."""
    truncated: NDArray[np.bool_]
    """(B,) at the time limit."""
    success: NDArray[np.bool_]
    """(B,) whether the task would count as achieved if the episode ended now."""
    sent_action: Array
    """(B, 7) after the rate limit and the box."""
    parts: tuple[dict[str, bool], ...]
    """(B,) ``success`` of each part of a sequence; empty in a row of a single task."""


def decided(config: EnvConfig) -> EnvConfig:
    """``config`` with what it leaves to its low-level controller (see
    `EnvConfig.for_controller`); what a command checks, hands on and records. The file of a
    controller is named by its absolute path."""
    config = config.for_controller(make_controller(config.controller).walks)
    return replace(config, controller=absolute_controller(config.controller))


class VectorEnv:
    """B robots, each in an episode of its own.

    Args:
        pictures: false: depth stays empty, which saves the rays; all else is as with them.

    Raises:
        UsageError: unknown task, wrong shapes, or actions that are not numbers.
    """

    def __init__(
        self,
        config: EnvConfig,
        num_envs: int,
        controller: LowLevelController | None = None,
        pictures: bool = True,
    ) -> None:
        if num_envs < 1 or config.threads < 1:
            raise UsageError(
                f"num_envs and threads count from 1, found {num_envs} and {config.threads}"
            )
        self.num_envs = num_envs
        self.controller = controller or make_controller(config.controller)
        self.config = config = config.for_controller(self.controller.walks)
        self.lanes: list[Lane] = []
        self._camera = DepthCamera(config.camera)
        self._pictures = pictures
        self._standing = settle(build_scene("ball", config.feet), self.controller)
        self._pool = ThreadPoolExecutor(config.threads) if config.threads > 1 else None
        self._controller_state = np.zeros((num_envs, STATE_DIM))
        # newest first: sent actions that may still be on their way
        slowest = -(-config.delay.action_ticks[1] // CONTROLLER_TICKS_PER_PLAN)
        self._sent = np.zeros((num_envs, 1 + slowest, ACTION_DIM))

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The episode of each row."""
        return tuple(lane.scenario for lane in self.lanes)

    @property
    def parameters(self) -> tuple[dict[str, float], ...]:
        """What was drawn for each row's episode, for the record: physics, delays, geometry."""
        return tuple(lane.parameters for lane in self.lanes)

    @property
    def sent_action(self) -> Array:
        """(B, 7) the last action sent; neutral at the start of an episode."""
        return self._sent[:, 0].copy()

    @property
    def tick(self) -> NDArray[np.int64]:
        """(B,) planner ticks done in each episode."""
        return np.array([lane.tick for lane in self.lanes])

    @property
    def done(self) -> NDArray[np.bool_]:
        """(B,) rows whose episode is over."""
        return np.array([lane.done for lane in self.lanes])

    def reset(self, scenarios: Sequence[Scenario]) -> Observation:
        """Start an episode in every row."""
        if len(scenarios) != self.num_envs:
            raise UsageError(f"expected {self.num_envs} scenarios, found {len(scenarios)}")
        if not self.lanes:
            self.lanes = [self._lane(scenario) for scenario in scenarios]
            return self._begin(np.arange(self.num_envs), None)
        self._start_lanes(range(self.num_envs), scenarios)
        return self._begin(np.arange(self.num_envs), None)

    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> Observation:
        """Start a new episode in some rows, the others stay as they are."""
        if not self.lanes:
            raise UsageError("reset_rows before the first reset; call reset first")
        if len(rows) != len(scenarios):
            raise UsageError(f"expected {len(rows)} scenarios, found {len(scenarios)}")
        self._start_lanes(rows, scenarios)
        which = np.asarray(rows, dtype=np.intp)
        return self._begin(which, which)

    def _lane(self, scenario: Scenario) -> Lane:
        return Lane(self.config, self._camera, self._standing, scenario, self._pictures)

    def _start_lanes(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> None:
        for row, scenario in zip(rows, scenarios, strict=True):
            self.lanes[row].start(scenario)

    def _begin(
        self, rows: NDArray[np.intp], controller_rows: NDArray[np.intp] | None
    ) -> Observation:
        self._sent[rows] = 0.0
        self._measure(self._sent[:, 0])
        self.controller.reset(self._controller_state, controller_rows)
        return self._observe()

    def step(self, action: NDArray[np.floating]) -> StepResult:
        """Send one normalised action (B, 7) per row and let a planner tick (40 ms) pass."""
        live = ~self.done
        self._send(action, live)
        for k in range(CONTROLLER_TICKS_PER_PLAN):
            self._measure(self._due_action(k))
            self._advance(self.controller.step(self._controller_state))
        terms = [lane.end_tick(self._sent[row, 0]) for row, lane in enumerate(self.lanes)]
        return self._result(terms)

    def _send(self, action: NDArray[np.floating], live: NDArray[np.bool_]) -> None:
        """Limit the rate, clip to the box, and put the action on its way."""
        wanted = np.asarray(action, dtype=np.float64)
        if wanted.shape != (self.num_envs, ACTION_DIM):
            raise UsageError(
                f"expected actions of shape {(self.num_envs, ACTION_DIM)}, found {wanted.shape}"
            )
        if not np.all(np.isfinite(wanted)):
            rows = np.flatnonzero(~np.isfinite(wanted).all(axis=1))
            raise UsageError(f"actions must be finite, found NaN or Inf in rows {rows.tolist()}")
        last = self._sent[:, 0]
        limited = last + np.clip(wanted - last, -ACTION_RATE_LIMIT, ACTION_RATE_LIMIT)
        sent = np.where(live[:, None], np.clip(limited, -1.0, 1.0), last)
        self._sent = np.concatenate([sent[:, None], self._sent[:, :-1]], axis=1)

    def _due_action(self, k: int) -> Array:
        """(B, 7) the action in effect in controller tick ``k`` of this planner tick."""
        delay = np.array([lane.action_delay for lane in self.lanes])
        age = np.maximum(0, -((k - delay) // CONTROLLER_TICKS_PER_PLAN))
        due: Array = self._sent[np.arange(self.num_envs), age]
        return due

    def _measure(self, action: Array) -> None:
        """The controllers' observations: fresh measurements and the command in effect."""
        for row, lane in enumerate(self.lanes):
            self._controller_state[row] = lane.state
        self._controller_state[:, COMMAND_SLICE] = self._command(action)

    def _command(self, action: Array) -> Array:
        """(B, 7) normalised actions -> (B, 10) commands [v, hands, height]."""
        velocity = np.array([lane.task.velocity_command for lane in self.lanes])
        return np.concatenate([velocity, ACTION_BOX.to_metric(action)], axis=1)

    def _observe(self) -> Observation:
        state = np.array([lane.state for lane in self.lanes])
        state[:, COMMAND_SLICE] = self._command(self._sent[:, 0])
        depth = np.empty((self.num_envs, DEPTH_ROWS, DEPTH_COLS), dtype=np.uint16)
        for row, lane in enumerate(self.lanes):
            depth[row] = lane.depth
        return Observation(depth, state.astype(np.float32))

    def _result(self, terms: list[dict[str, float]]) -> StepResult:
        names = dict.fromkeys(name for lane in self.lanes for name in lane.task.terms)
        by_name = {name: np.array([t.get(name, 0.0) for t in terms]) for name in names}
        return StepResult(
            observation=self._observe(),
            reward=np.sum(list(by_name.values()), axis=0),
            reward_terms=by_name,
            terminated=np.array([lane.terminated for lane in self.lanes]),
            truncated=np.array([lane.truncated for lane in self.lanes]),
            success=np.array([lane.task.success for lane in self.lanes]),
            sent_action=self.sent_action,
            parts=tuple(lane.task.parts for lane in self.lanes),
        )

    def _advance(self, targets: Array) -> None:
        """One controller tick of every row; physics and rays release the interpreter lock."""

        def work(rows: NDArray[np.intp]) -> None:
            for row in rows:
                self.lanes[row].advance(targets[row])

        chunks = np.array_split(np.arange(self.num_envs), self.config.threads)
        if self._pool is None:
            work(chunks[0])
            return
        for pending in [self._pool.submit(work, rows) for rows in chunks]:
            pending.result()

    def damp(self, row: int) -> None:
        """Damp the motors of ``row`` until its next episode, whatever the controller says."""
        self.lanes[row].robot.damp()

    def snapshot(self) -> Truth:
        """The simulator's truth now: for oracles, probes and logs, never for a policy."""
        return snapshot(self.lanes)

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
