"""The world model as a policy: filter an observation, plan, report what was imagined."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.model import Carry, WorldModel
from egovcp.plan.backends import judge_of_model
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import Judge
from egovcp.plan.optimisers import optimiser_of
from egovcp.plan.process import shift
from egovcp.plan.search import make_plan

type Array = NDArray[np.float32]


class PolicyStep(NamedTuple):
    """What the policy decided for E robots, as numpy arrays."""

    action: Array  # (E, 7) in [-1, 1]
    plan: Array  # (E, N, 7)
    value: Array  # (E,) J of the plan
    termination: Array  # (E,) probability at the filtered state
    candidates: Array  # (E, elites, N, 7), best first
    candidate_values: Array  # (E, elites)
    iterations: int


class Policy:
    """Filters and plans for E robots in step; call `act`, then `advance`, once a tick.

    The recurrence advances with the action that was actually sent, so `advance` must be
    told what the safety layer made of the planned one. The planner packs the model's weights
    when they are first needed; later changes of them are not seen.
    """

    def __init__(
        self, model: WorldModel, config: PlannerConfig, num_envs: int, seed: int = 0
    ) -> None:
        self.model = model.eval()
        self.config = config
        self.num_envs = num_envs
        self._seed = seed
        self._judge: Judge[Carry] | None = None
        self.reset()

    @torch.inference_mode()
    def reset(self, rows: NDArray[np.intp] | None = None) -> None:
        """Forget the past of ``rows`` (None: of all, and restart the random stream)."""
        if rows is None:
            device, envs = self._device, self.num_envs
            self._carry = self.model.initial(envs)
            self._sent = torch.zeros(envs, spec.ACTION_DIM, device=device)
            self._first = torch.ones(envs, dtype=torch.bool, device=device)
            self._warm = torch.zeros(envs, self.config.actions, spec.ACTION_DIM, device=device)
            self._generator = torch.Generator(device).manual_seed(self._seed)
            return
        index = torch.as_tensor(rows, device=self._device)
        self._first[index] = True
        self._sent[index] = 0.0
        self._warm[index] = 0.0

    @torch.inference_mode()
    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Take depth (E, 48, 64) mm and state (E, 74) into the recurrence, without planning."""
        self._carry = self.model.observe(
            self._carry,
            self._sent,
            torch.from_numpy(depth.astype(np.int32)).to(self._device),
            torch.as_tensor(state, dtype=torch.float32, device=self._device),
            self._first,
        )
        self._first = torch.zeros_like(self._first)

    @torch.inference_mode()
    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """Depth (E, 48, 64) mm and state (E, 74) -> the plan from here.

        Args:
            depth: as sensed.
            state: as sensed.
            remaining: seconds until the answer is due (`egovcp.plan.until`); the planner runs
                as many iterations as fit, at least one. None: all of them, the same on every
                machine that computes the same.
        """
        self.observe(depth, state)
        plan = make_plan(
            self.prepare(),
            optimiser_of(self.config, self._device),
            self._carry,
            self._sent,
            self.config,
            self._generator,
            self._warm,
            remaining,
        )
        self._warm = shift(plan.deltas)
        return PolicyStep(
            _numpy(plan.actions[:, 0]).copy(),
            _numpy(plan.actions),
            _numpy(plan.value),
            _numpy(self.model.termination(self._carry)),
            _numpy(plan.candidates),
            _numpy(plan.candidate_values),
            plan.iterations,
        )

    def prepare(self) -> Judge[Carry]:
        """Pack the planner now and not at the first observation: it may have to be compiled.

        Raises:
            UsageError: the backend does not go with the model.
            EnvironmentFailure: the backend cannot be built here.
        """
        if self._judge is None:
            self._judge = judge_of_model(self.model, self.config)
        return self._judge

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Tell the recurrence which action (E, 7) was really sent."""
        self._sent = torch.from_numpy(np.array(sent, np.float32)).to(self._device)

    @property
    def _device(self) -> torch.device:
        """Where the model lies; noise differs between devices, and so do plans."""
        return self.model.state_mean.device

    @property
    def carry(self) -> Carry:
        """The filtered state, for probes and logs; of inference mode: no gradient passes it."""
        return self._carry

    @torch.inference_mode()
    def reconstruct(self) -> Array:
        """Depth (E, 48, 64) in metres decoded from the filtered state; 0 = nothing there."""
        return _numpy(self.model.decode(self._carry)[0])

    @torch.inference_mode()
    def imagine(self, plan: NDArray[np.floating], horizon: int) -> Array:
        """Depth (E, horizon, 48, 64), metres, imagined under ``plan`` (E, N, 7).

        Beyond the plan's end its last action is held.
        """
        actions = torch.as_tensor(plan, dtype=torch.float32, device=self._device)
        carry, path = self._carry, list[Carry]()
        for k in range(horizon):
            carry = self.model.imagine(carry, actions[:, min(k, actions.shape[1] - 1)])
            path.append(carry)
        # one decoder call for all of them: a quarter of the time of one call each
        states = Carry.join(path, lambda parts: torch.stack(parts, 1).flatten(0, 1))
        film = _numpy(self.model.decode(states)[0])
        return film.reshape(-1, horizon, *film.shape[1:])


def _numpy(x: Tensor) -> Array:
    array: Array = x.cpu().numpy()
    return array
