"""A gradient step of the world model, the averaging of weights, and the budget of a run."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import torch
from torch import Tensor, nn

from egovcp.cuda_graphs import GraphedFunction
from egovcp.errors import DataError
from egovcp.model import Batch, StepNoise, WorldModel, sample_step_noise, world_model_gradients
from egovcp.model.latent_state import Carry
from egovcp.model.value_losses import TargetNetwork
from egovcp.plan import PlannerConfig
from egovcp_train.config import OptimizerConfig
from egovcp_train.device import precision
from egovcp_train.privileged_value import Critic

_MAX_GRAPHS: Final = 64
"""Most captured graphs: one per combination of the integers in `StepNoise`, 8 by default."""
_CRITIC_START: Final = 0.1
"""Part of the steps, or of the time for them, before the critic is updated: until then Q, which
chooses the critic's next action, cannot rank actions."""
_MAX_SKIPPED: Final = 3  # consecutive steps whose loss or gradient is not finite

type Gradients = tuple[tuple[str, ...], Tensor, tuple[Tensor | None, ...], Carry]
"""Names and values (n,) of the terms, the gradients of all parameters, the filtered states."""


class Learner:
    """Model, averaged model, optimiser, the random stream of the steps, and what predicts the
    target of Q: the critic, or under ``q_target=td`` the target network.

    A step has about a thousand small kernels. On a GPU it is launch-bound, so its gradient is
    captured as a CUDA graph (`egovcp.cuda_graphs`).
    """

    def __init__(
        self,
        model: WorldModel,
        config: OptimizerConfig,
        seed: int,
        bf16: bool = False,
        planner: PlannerConfig | None = None,
    ) -> None:
        """
        Args:
            model: the networks, which are trained in place.
            config: learning rate, regularisation and averaging.
            seed: seed of the random stream of the steps.
            bf16: compute matrix products in bfloat16.
            planner: its costs choose the critic's next action; None: the defaults.
        """
        self.model = model
        self.config = config
        self.bf16 = bf16
        self.planner = planner or PlannerConfig()
        self.critic: Critic | None = None
        self.averaged = copy.deepcopy(model).requires_grad_(False)
        self.target = TargetNetwork(model) if model.config.loss.q_target == "td" else None
        self.optimizer = torch.optim.AdamW(
            model.parameters(), lr=config.lr, weight_decay=config.weight_decay, fused=True
        )
        device = model.state_mean.device
        self.generator = torch.Generator(device=device).manual_seed(seed)
        self.step = 0
        self._skipped = 0
        self._parameters = list(model.parameters())
        self._gradients: Callable[[Batch, StepNoise], Gradients] = self._compute_gradients
        if device.type == "cuda":
            self._gradients = GraphedFunction(
                self._compute_gradients, max_graphs=_MAX_GRAPHS, copies=False
            )

    @property
    def capture_error(self) -> str:
        """Error of the last capture of a step that failed; empty: none failed."""
        return self._gradients.error if isinstance(self._gradients, GraphedFunction) else ""

    def update(self, batch: Batch, progress: float) -> dict[str, Tensor]:
        """One gradient step at ``progress`` in [0, 1]; returns scalar metrics."""
        self.model.train()
        lr = self.learning_rate(progress)
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        noise = sample_step_noise(self.model, batch, self.generator)
        names, values, gradients, states = self._gradients(batch, noise)
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        terms = dict(zip(names, values.clone(), strict=True))
        norm = torch.nn.utils.clip_grad_norm_(self._parameters, self.config.grad_clip)
        probe = norm + terms["loss/total"]
        critic = self.critic if progress >= _CRITIC_START else None
        if critic:
            critic.set_learning_rate(self.config.privileged_value.training_lr * lr / self.config.lr)
            terms["loss/critic"] = critic.compute_gradients(
                self.model, batch, states, noise.actions, self.generator, self.bf16
            )
            probe = probe + terms["loss/critic"]
        if self._accept_step(probe):
            self.optimizer.step()
            self._average()
            if critic:
                critic.step()
            if self.target:
                self.target.update(self.model, self.model.config.loss.td_decay)
        self.step += 1
        return {**terms, "grad_norm": norm}

    def _compute_gradients(self, batch: Batch, noise: StepNoise) -> Gradients:
        critic: nn.Module | None = self.target.head if self.target else None
        if self.critic:
            critic = self.critic.value
        in_precision = partial(precision, batch.state.device, self.bf16)
        with torch.enable_grad():
            loss, terms, states = world_model_gradients(
                self.model, batch, noise, critic, in_precision
            )
        terms = {**terms, "loss/total": loss}
        gradients = tuple(parameter.grad for parameter in self._parameters)
        return tuple(terms), torch.stack(list(terms.values())), gradients, states

    def learning_rate(self, progress: float) -> float:
        """lr * min(1, step / warmup_steps) * (0.1 + 0.45 (1 + cos(pi progress)))."""
        warm = min(1.0, (self.step + 1) / max(1, self.config.warmup_steps))
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))
        return self.config.lr * warm * (0.1 + 0.9 * cosine)

    def require_finite(self) -> None:
        """Raise `DataError` if the weights are not finite."""
        values = [*self.model.parameters(), *self.averaged.parameters()]
        values += self.critic.parameters if self.critic else []
        if not all(bool(x.isfinite().all()) for x in values):
            raise DataError(
                f"the weights are not finite after step {self.step}, so they are not saved; the "
                "last good checkpoint, if there is one, is kept: lower --optimizer.lr"
            )

    def _accept_step(self, probe: Tensor) -> bool:
        """Count the step as good or skipped; returns whether it is taken.

        Args:
            probe: sum of the losses and the norm of the model's gradient; not finite if one of them
                is not. The critic's gradient is not included.

        Raises:
            DataError: `_MAX_SKIPPED` consecutive steps are skipped.
        """
        if torch.isfinite(probe):
            self._skipped = 0
            return True
        self._skipped += 1
        if self._skipped >= _MAX_SKIPPED:
            raise DataError(
                f"loss or gradient was not finite in {_MAX_SKIPPED} consecutive steps (step "
                f"{self.step + 1}); the last good checkpoint, if there is one, is kept: check the "
                "dataset, or lower --optimizer.lr"
            )
        return False

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
        means: list[Tensor] = list(self.averaged.parameters())
        values: list[Tensor] = list(self.model.parameters())
        torch._foreach_lerp_(means, values, 1 - decay)

    def state_dict(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            **({"target": self.target.state_dict()} if self.target else {}),
            "critic": self.critic.state_dict() if self.critic else None,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`; call it before the first update."""
        self.step = state["step"]
        self.model.load_state_dict(state["model"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        if self.target:
            self.target.load_state_dict(state["target"])
        if state["critic"]:
            self.critic = Critic.restore(state["critic"], self.model, self.planner)


class Budget:
    """Progress of a run towards its number of steps or its time limit."""

    def __init__(
        self,
        steps: int,
        max_minutes: float,
        clock: Callable[[], float] = time.monotonic,
        spent: float = 0.0,
        fit_seconds: float = 0.0,
    ) -> None:
        """
        Args:
            max_minutes: time limit; 0: none.
            spent: seconds that the run took before it was resumed, or before its first step.
            fit_seconds: seconds before the first step, part of the limit but not of the progress.
        """
        self.steps, self.seconds, self._clock = steps, 60 * max_minutes, clock
        self._start = clock() - spent
        self.fit_seconds = fit_seconds

    @property
    def spent(self) -> float:
        """Seconds of the run, without pauses between a stop and a resume."""
        return self._clock() - self._start

    def progress(self, step: int) -> float:
        """Fraction of the steps, or of the time for them, that is done, in [0, 1]."""
        by_steps = step / self.steps
        if not self.seconds:
            return min(1.0, by_steps)
        spent = self.spent
        if spent >= self.seconds:
            return 1.0
        by_time = (spent - self.fit_seconds) / (self.seconds - self.fit_seconds)
        return min(1.0, max(by_steps, by_time))
