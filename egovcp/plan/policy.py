"""The world model as a policy: filter an observation, plan, and imagine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel
from egovcp.plan.backends import make_evaluator
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import MirroredEvaluator, PlanEvaluator, mirrored_actions
from egovcp.plan.optimisers import optimiser_of
from egovcp.plan.search import make_plan, shift
from egovcp.robot_spec import G1, RobotSpec

type Array = NDArray[np.float32]

LARGEST_STATE: Final = 1e3
"""Bound of all quantities of the G1's proprioception, in the units of `spec.STATE_SLICES`."""
_LARGEST_FLOAT: Final = float(np.finfo(np.float32).max)

_NONE: Final[Array] = np.zeros(0, np.float32)


class PolicyStep(NamedTuple):
    """Result of a planner step for E robots; fields that a policy does not compute are empty."""

    action: Array  # (E, 7) in [-1, 1]
    plan: Array = _NONE  # (E, P, 7)
    value: Array = _NONE  # (E,) J of the plan
    termination: Array = _NONE  # (E,) probability at the filtered state
    candidates: Array = _NONE  # (E, elites, P, 7), best first
    candidate_values: Array = _NONE  # (E, elites)
    iterations: int = 0
    skipped: NDArray[np.bool_] = np.zeros(0, np.bool_)  # (E,) see `Policy.skipped`


class Policy:
    """Filters observations and plans for E robots; call `act`, then `advance`, once per step.

    If a robot's state is not finite, or that of a G1 exceeds `LARGEST_STATE`, its observation is
    skipped and the prior predicts this step. Depth that is not finite counts as invalid (0).

    The recurrence advances with the action that was sent, after the safety layer: pass it to
    `advance`. The model's weights are packed at the first plan; later changes are not seen. Shapes
    below are the G1's; those of another robot are in the model's `RobotSpec`.

    Under ``mirror``, the mirrored observations of a symmetric robot are filtered, too, and plans
    are evaluated from both states (`MirroredEvaluator`).
    """

    def __init__(
        self, model: WorldModel, config: PlannerConfig, num_envs: int, seed: int = 0
    ) -> None:
        self.model = model.eval()
        self.config = config
        self.num_envs = num_envs
        self._views = 2 if config.mirror and model.robot.mirror else 1
        self._largest_state = LARGEST_STATE if model.robot.is_g1 else _LARGEST_FLOAT
        self._seed = seed
        self._evaluator: PlanEvaluator[Carry] | None = None
        self.skipped: NDArray[np.bool_] = np.zeros(num_envs, np.bool_)
        """(E,) whether the last observation of each robot was skipped."""
        self.reset()

    @torch.inference_mode()
    def reset(self) -> None:
        """Reset all robots and the random generator."""
        device, envs = self._device, self.num_envs
        actions = self.model.robot.action_dim
        self._carry = self.model.initial(self._views * envs)  # the mirrored states follow
        self._sent = torch.zeros(envs, actions, device=device)
        self._first = torch.ones(envs, dtype=torch.bool, device=device)
        self._warm = torch.zeros(envs, self.config.actions, actions, device=device)
        self._generator = torch.Generator(device).manual_seed(self._seed)

    @torch.inference_mode()
    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Take depth (E, 48, 64) mm and state (E, 74) into the recurrence, without planning.

        Raises:
            UsageError: another shape.
        """
        self._check_shapes(depth, state)
        if np.issubdtype(depth.dtype, np.floating):
            depth = np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)
        valid = (np.abs(state) <= self._largest_state).all(1)  # false for NaN and infinity
        depth = depth.astype(np.int32)
        state = np.where(valid[:, None], state, 0.0).astype(np.float32)
        if self._views > 1:
            depth = np.concatenate([depth, depth[..., ::-1]])
            state = np.concatenate([state, self.model.robot.mirrored_state(state)])
        before, first = self._carry, self._first
        observed = self.model.observe(
            before,
            self._sent_views(),
            torch.from_numpy(depth).to(self._device),
            torch.from_numpy(state).to(self._device),
            first.repeat(self._views),
        )
        finite = _finite_rows(observed).view(self._views, -1).all(0)
        usable = torch.from_numpy(valid).to(self._device) & finite
        if bool(usable.all()):
            self._carry, self._first = observed, torch.zeros_like(first)
        else:
            predicted = self._predicted(before, first)
            self._carry = _choose_rows(usable.repeat(self._views), observed, predicted)
            self._first = first & ~usable  # it starts at the first usable observation
        self.skipped = ~usable.cpu().numpy()

    def _predicted(self, carry: Carry, first: Tensor) -> Carry:
        """The carry at this step without its observation; from zeros where ``first`` (E,)."""
        first = first.repeat(self._views)
        start = _choose_rows(first, self.model.initial(len(first)), carry)
        return self.model.imagine(start, self._sent_views().masked_fill(first[:, None], 0.0))

    def _sent_views(self) -> Tensor:
        """The last action that was sent, and its mirror image if that is used, (views E, 7)."""
        if self._views == 1:
            return self._sent
        return torch.cat([self._sent, mirrored_actions(self._sent, self.model.robot)])

    def _check_shapes(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        expected = (
            (self.num_envs, *self.model.robot.depth),
            (self.num_envs, self.model.robot.state_dim),
        )
        if (depth.shape, state.shape) != expected:
            raise UsageError(
                f"depth {depth.shape} and state {state.shape}: expected {expected[0]} and "
                f"{expected[1]}, for {self.num_envs} robots"
            )

    @torch.inference_mode()
    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """Observe depth (E, 48, 64) mm and state (E, 74), and plan.

        Args:
            remaining: seconds until the result is due (`egovcp.plan.time_left_until`); the planner
                does as many iterations as fit, at least one. None: all of them.
        """
        self.observe(depth, state)
        evaluator = self.prepare()
        if self._views > 1:
            evaluator = MirroredEvaluator(evaluator, self.model.robot)
        plan = make_plan(
            evaluator,
            optimiser_of(self.config, self._device),
            self._carry,
            self._sent,
            self.config,
            self._generator,
            self._warm,
            remaining,
            self.model.discount,
        )
        self._warm = shift(plan.deltas)
        return PolicyStep(
            _numpy(plan.actions[:, 0]).copy(),
            _numpy(plan.actions),
            _numpy(plan.value),
            _numpy(self.model.termination(self.carry)),
            _numpy(plan.candidates),
            _numpy(plan.candidate_values),
            plan.iterations,
            self.skipped.copy(),
        )

    def prepare(self) -> PlanEvaluator[Carry]:
        """Pack the planner, and compile it if necessary.

        Raises:
            UsageError: the backend does not support the model.
            EnvironmentFailure: the backend cannot be built on this machine.
        """
        if self._evaluator is None:
            self._evaluator = make_evaluator(self.model, self.config)
        return self._evaluator

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Set the action (E, 7) that was sent, for the recurrence.

        Raises:
            UsageError: another shape, or it is not finite.
        """
        expected = (self.num_envs, self.model.robot.action_dim)
        if np.shape(sent) != expected:
            raise UsageError(
                f"sent has shape {np.shape(sent)}, expected {expected}: one action per robot"
            )
        if not np.isfinite(sent).all():
            raise UsageError("the action that was sent is not finite; report what the robot took")
        self._sent = torch.from_numpy(np.array(sent, np.float32)).to(self._device)

    @property
    def _device(self) -> torch.device:
        """Device of the model. Random numbers, and so plans, differ between devices."""
        return self.model.state_mean.device

    @property
    def carry(self) -> Carry:
        """The filtered state (E, ...), for probes and logs; without gradients."""
        return self._carry.map(lambda x: x[: self.num_envs])

    @torch.inference_mode()
    def reconstruct(self) -> Array:
        """Depth (E, 48, 64) in metres decoded from the filtered state; 0 = invalid."""
        return _numpy(self.model.decode(self.carry)[0])

    @torch.inference_mode()
    def imagine(self, plan: NDArray[np.floating], horizon: int) -> Array:
        """Depth (E, horizon, 48, 64), metres, imagined under ``plan`` (E, P, 7).

        Beyond the plan's end its last action is held.
        """
        actions = torch.as_tensor(plan, dtype=torch.float32, device=self._device)
        carry, path = self.carry, list[Carry]()
        for k in range(horizon):
            carry = self.model.imagine(carry, actions[:, min(k, actions.shape[1] - 1)])
            path.append(carry)
        states = Carry.join(path, lambda parts: torch.stack(parts, 1).flatten(0, 1))
        depth = _numpy(self.model.decode(states)[0])
        return depth.reshape(-1, horizon, *depth.shape[1:])


def blank_observation(num_envs: int, robot: RobotSpec = G1) -> tuple[NDArray[np.uint16], Array]:
    """Depth (E, H, W) mm without a valid pixel and state (E, S): zeros, or an upright G1."""
    depth = np.zeros((num_envs, *robot.depth), np.uint16)
    state = np.zeros((num_envs, robot.state_dim), np.float32)
    if robot.is_g1:
        state[:, spec.STATE_SLICES["projected_gravity"].stop - 1] = -1.0
    return depth, state


def _finite_rows(carry: Carry) -> Tensor:
    """(E,) whether all numbers of a robot's carry (E, ...) are finite."""
    return torch.stack([part.isfinite().all(1) for part in carry]).all(0)


def _choose_rows(rows: Tensor, chosen: Carry, other: Carry) -> Carry:
    """Of each robot the carry ``chosen`` where ``rows`` (E,), else ``other``."""

    def choose(parts: list[Tensor]) -> Tensor:
        return torch.where(rows[:, None], parts[0], parts[1])  # each part is (E, n)

    return Carry.join((chosen, other), choose)


def _numpy(x: Tensor) -> Array:
    array: Array = x.cpu().numpy()
    return array
