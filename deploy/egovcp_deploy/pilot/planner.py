"""The planner as the pilot uses it: observations go in, plans come out later.

    client.submit(o_t)  ...  client.poll() -> plans, each made from one observation

`PlannerRunner` filters every observation in order and plans from the newest. `InlinePlanner` runs
it in lock-step with simulated time; `live.link.RemotePlanner` reaches it in another process.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.hardware import available_cores
from egovcp.log.tick import Candidates, Hand, MotorReadings, ValueMap
from egovcp.plan import (
    PlannerConfig,
    Policy,
    PolicyStep,
    blank_observation,
    hand_grid,
    value_map,
)
from egovcp.plan.objective import Dynamics
from egovcp.plan.value_map import HAND_AXES
from egovcp.robot_spec import G1, RobotSpec
from egovcp.spec import ACTION_BOX, ACTION_HANDS

SKIPPED: Final = "observation skipped: its state is not finite, or impossible"
BACKLOG: Final = 8  # observations that can wait for a busy planner, at least; newer ones are lost
LOGGED_CANDIDATES: Final = 32  # best first; more would clutter the log
BUDGET_S: Final = 0.034  # from an observation to its plan; the rest of the tick transports it
POOR_TO_HALVE: Final = 3  # late or incomplete plans; two good plans compensate for one
GOOD_TO_DOUBLE: Final = 50  # consecutive good plans, 2 s
_COMPENSATION: Final = 0.5
_MIN_SAMPLES: Final = 16
_MIN_ELITES: Final = 4  # the mean of two follows Q's errors too closely (docs/planner.md)
_HANDS: Final[tuple[Hand, ...]] = ("left", "right")


class RolloutPolicy(Protocol):
    """Decides for E robots in step, from their observations."""

    def reset(self) -> None:
        """Every robot has just begun an episode."""

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """Depth (E, 48, 64) mm and state (E, 74) -> plans, within ``remaining()`` s. Arrays that
        the policy does not compute are empty."""

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Filter depth (E, 48, 64) mm and state (E, 74) without planning."""

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Advance by a tick with the actions (E, 7) that were sent."""


def leave_core() -> None:
    """Plan with one thread less than there are cores, unless the user limits the threads.

    The control process and the logs need a core: planning threads that wait for one that was
    preempted are slower than fewer threads.
    """
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(max(1, available_cores() - 1))


def backend_of(policy: RolloutPolicy) -> str:
    """Name of the backend that computes the plans, with ``auto`` resolved; empty: no planner."""
    if not isinstance(policy, Policy):
        return ""
    return policy.prepare().backend


def value_maps[L](
    model: Dynamics[L], carry: L, action: NDArray[np.floating], config: PlannerConfig
) -> tuple[ValueMap, ...]:
    """J of the planned ``action`` (7,) with each hand moved over its box, for one robot whose
    filtered state is ``carry`` (1, ...)."""
    planned = torch.as_tensor(action, dtype=torch.float32, device=model.min_return.device)
    target = ACTION_BOX.to_metric(np.asarray(action))
    maps = []
    for hand in _HANDS:
        grid = hand_grid(hand)
        values = value_map(model, carry, planned[None], hand, grid, config)[0].float().cpu().numpy()
        y = float(np.float32(target[HAND_AXES[hand][1]]))
        maps.append(ValueMap(hand, grid.x, y, grid.z, values))
    return tuple(maps)


@dataclass(frozen=True)
class ObservationMessage:
    """One observation o_t for the planner."""

    tick: int  # t, planner ticks; increases without gaps
    time_ns: int  # when o_t was assembled, monotonic
    depth: NDArray[np.uint16]  # (48, 64) mm, 0 invalid
    state: NDArray[np.float32]  # (74,) proprioception; its command is the one sent before
    sent: NDArray[np.float64]  # (7,) a_{t-1} as it was sent
    first: bool = False  # whether the recurrence starts here: from zeros, with a_{t-1} neutral
    mode: str = ""  # `State` of the robot's state machine
    events: tuple[str, ...] = ()  # log lines since the last observation
    motors: MotorReadings | None = None  # of the newest reading, for the log
    link: Mapping[str, float] = field(default_factory=dict)  # `Tick.link`, for the log


@dataclass(frozen=True)
class PlanMessage:
    """The plan made from the observation of ``tick``."""

    tick: int
    step: PolicyStep  # for one robot
    plan_ms: float  # time to filter and plan
    events: tuple[str, ...] = ()  # log lines of the planner
    reconstructed: NDArray[np.float32] | None = None  # (48, 64) m: o_t decoded, for the log
    imagined: NDArray[np.float32] | None = None  # (K, 48, 64) m: predictions 1..K ticks ahead
    value_maps: tuple[ValueMap, ...] = ()

    @property
    def actions(self) -> NDArray[np.float64]:
        """(P, 7) the plan; of a policy that does not plan, its one action."""
        return np.asarray(self.step.plan[0] if self.step.plan.size else self.step.action, float)


class PlannerClient(Protocol):
    """Takes observations and returns plans. No call blocks."""

    def submit(self, observation: ObservationMessage) -> bool:
        """Send o_t to the planner; whether it was sent."""

    def poll(self, now_ns: int) -> list[PlanMessage]:
        """Plans that have arrived by ``now_ns``, oldest first."""

    @property
    def alive(self) -> bool:
        """False once the planner is known to have ended."""


class AdaptiveBudget:
    """Halves the samples of a planner that lacks time, and doubles them again, up to those of the
    configuration ``full``, when it does not.

    A plan cut short by its deadline has too few iterations; fewer samples in all iterations are
    better than many samples in one.
    """

    def __init__(self, full: PlannerConfig) -> None:
        self._full = full
        self.config = full  # configuration of the next plan
        self._poor, self._good = 0.0, 0

    def record(self, late: bool, iterations: int) -> bool:
        """Count one plan with its iterations; true if `config` has changed."""
        poor = late or iterations < self.config.iterations
        self._poor = self._poor + 1 if poor else max(0.0, self._poor - _COMPENSATION)
        self._good = 0 if poor else self._good + 1
        if self._poor >= POOR_TO_HALVE:
            return self._scale(self.config.samples // 2)
        if self._good >= GOOD_TO_DOUBLE:
            return self._scale(self.config.samples * 2)
        return False

    def _scale(self, samples: int) -> bool:
        self._poor, self._good = 0.0, 0
        full = self._full
        samples = min(max(samples, _MIN_SAMPLES), full.samples)
        elites = min(max(full.elites * samples // full.samples, _MIN_ELITES), full.elites)
        changed = samples != self.config.samples
        self.config = replace(full, samples=samples, elites=elites)
        return changed


class PlannerRunner:
    """Filters every observation and plans from the newest, for one robot. For the log it decodes
    the predictions of ``imagine`` ticks; 0 decodes nothing."""

    def __init__(self, policy: RolloutPolicy, imagine: int = 0) -> None:
        self._policy = policy
        self._budget = AdaptiveBudget(policy.config) if isinstance(policy, Policy) else None
        self._imagine = imagine
        decodes = imagine and hasattr(policy, "reconstruct")  # as a `Policy`
        self._imagining: Any = policy if decodes else None
        self._next_tick: int | None = None

    def plan(
        self,
        observations: Sequence[ObservationMessage],
        remaining: Callable[[], float] | None = None,
    ) -> PlanMessage:
        """Filter ``observations`` in order and plan from the last, which is due in ``remaining()``
        s. A gap between their ticks restarts the recurrence. Nothing is decoded: see `decode`."""
        begin = time.perf_counter()
        events = list[str]()
        *older, last = observations
        for observation in older:
            events += self._advance(observation)
            self._policy.observe(observation.depth[None], observation.state[None])
            events += self._skipped()
        events += self._advance(last)
        step = self._policy.act(last.depth[None], last.state[None], remaining)
        events += self._skipped()
        plan_ms = (time.perf_counter() - begin) * 1e3
        return PlanMessage(last.tick, step, plan_ms, events=tuple(events))

    def adapt(self, plan: PlanMessage, late: bool) -> tuple[str, ...]:
        """Adapt the number of samples to whether ``plan`` was late; a log line if it has
        changed."""
        if self._budget is None or not self._budget.record(late, plan.step.iterations):
            return ()
        assert isinstance(self._policy, Policy)
        before, self._policy.config = self._policy.config, self._budget.config
        after = self._policy.config.samples
        cause = "time to spare" if after > before.samples else "too little time"
        return (f"{cause}: {after} candidates from now on",)

    def warm_up(self) -> None:
        """Plan and decode on a blank observation: the first calls compile and allocate."""
        policy = self._policy
        robot = policy.model.robot if isinstance(policy, Policy) else G1
        depth, state = blank_observation(1, robot)
        sent = np.zeros(robot.action_dim)
        blank = ObservationMessage(0, 0, depth[0], state[0], sent, first=True)
        for _ in range(2):
            self.decode(self.plan([blank]))
        self._next_tick = None

    def decode(self, plan: PlanMessage) -> PlanMessage:
        """``plan`` with images for the log; call it before the next `plan`."""
        if self._imagining is None:
            return plan
        maps: tuple[ValueMap, ...] = ()
        policy = self._policy
        if isinstance(policy, Policy) and policy.model.robot.is_g1:  # of its hands
            maps = value_maps(policy.model, policy.carry, plan.step.action[0], policy.config)
        return replace(
            plan,
            reconstructed=self._imagining.reconstruct()[0],
            imagined=self._imagining.imagine(plan.step.plan, self._imagine)[0],
            value_maps=maps,
        )

    def _advance(self, observation: ObservationMessage) -> list[str]:
        """Advance the recurrence to ``observation``, or restart it. The next run of a robot begins
        at tick 0 again, which loses nothing."""
        expected = observation.tick if self._next_tick is None else self._next_tick
        lost = observation.tick - expected
        self._next_tick = observation.tick + 1
        if observation.first or lost:
            self._policy.reset()
        if not observation.first:
            self._policy.advance(observation.sent[None])
        return [f"planner lost {lost} observations: recurrence restarted"] if lost > 0 else []

    def _skipped(self) -> list[str]:
        policy = self._policy
        return [SKIPPED] if isinstance(policy, Policy) and policy.skipped.any() else []


class InlinePlanner:
    """A `PlannerClient` in lock-step with simulated time: planning takes none of it."""

    alive = True  # exceptions are raised in this process

    def __init__(self, runner: PlannerRunner) -> None:
        self._runner = runner
        self._plans: list[PlanMessage] = []

    def submit(self, observation: ObservationMessage) -> bool:
        """Plan from o_t."""
        self._plans.append(self._runner.decode(self._runner.plan([observation])))
        return True

    def poll(self, now_ns: int) -> list[PlanMessage]:
        """The plans since the last call."""
        plans, self._plans = self._plans, []
        return plans


def planner_fields(plan: PlanMessage | None, robot: RobotSpec = G1) -> dict[str, Any]:
    """The fields of `Tick` that come from the planner; unknown ones are left out. Candidates are
    the best ones as paths of the hands of a G1, m, heading frame."""
    if plan is None:
        return {}
    step, candidates = plan.step, None
    if step.candidates.size and robot.is_g1:
        actions = step.candidates[0, :LOGGED_CANDIDATES]  # (n, P, 7)
        hands = ACTION_BOX.to_metric(actions)[..., ACTION_HANDS].reshape(*actions.shape[:2], 2, 3)
        candidates = Candidates(hands, step.candidate_values[0, :LOGGED_CANDIDATES])
    return {
        "depth_reconstructed": plan.reconstructed,
        "depth_imagined": plan.imagined,
        "value_maps": plan.value_maps,
        "plan": step.plan[0] if step.plan.size else None,
        "candidates": candidates,
        "value": float(step.value[0]) if step.value.size else None,
        "termination": float(step.termination[0]) if step.termination.size else None,
    }
