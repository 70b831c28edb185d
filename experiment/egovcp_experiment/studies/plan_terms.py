"""Closed loop with single terms of the value of a plan instead of their mean (section III-D).

    mean    V = 1/N sum_{k<N} Q(h_k, z^_k, a_k)      (equation 15), the planner itself
    first   V = Q(h_0, z_0, a_0)
    last    V = Q(h_{N-1}, z^_{N-1}, a_{N-1})

The candidates are plans of N steps in all three, their costs and the rule for predicted failures
too. If the mean is better because errors of its terms average out, it is better than each of them.
The scenarios are those of ``egovcp-eval`` with the same seed, which plays the mean, and with
``--planner.horizon=1`` one step: `first` differs from it only in its candidates, whose steps after
the first, towards the target, cost action changes and poses although Q of them does not count.

Spread: standard deviation of each term over random plans from one state, root mean square over
states. The plans diverge with each step, so later terms differ more between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from egovcp.artifact import Artifact
from egovcp.errors import UsageError
from egovcp.model import Carry
from egovcp.plan import PlanEvaluator, Policy
from egovcp.plan.backends import make_evaluator
from egovcp.plan.objective import PlanValue
from egovcp.plan.search import random_walk, target_deltas
from egovcp.sim.scenario import HELD_OUT
from egovcp_experiment.studies import study

TERMS: Final = ("first", "last")
_PLANS: Final = 64  # random plans of a state
_EVERY: Final = 5  # ticks between the states of the spread


@dataclass(frozen=True)
class PlanTermsConfig(study.SimStudyConfig):
    """Play with the first or last term of the value of a plan alone, instead of their mean, on the
    scenarios of egovcp-eval."""

    def load(self) -> Artifact:
        """As `SimStudyConfig.load`; refuses another objective, and sampled latents."""
        artifact = super().load()
        for option, expected in (("objective", "value"), ("latent", "mean")):
            found = getattr(artifact.planner, option)
            if found != expected:
                raise UsageError(
                    f"--planner.{option}={found}: expected {expected}, whose terms are compared"
                )
        return artifact


class TermEvaluator(NamedTuple):
    """A `PlanEvaluator` of the n-th value of a plan as the planner counts it, n V_n - (n-1) V_{n-1}
    from means over n and n-1 steps."""

    n: int
    mean: PlanEvaluator[Carry]
    """V_n."""
    shorter: PlanEvaluator[Carry] | None
    """V_{n-1}; None of the first."""

    @property
    def backend(self) -> str:
        """See `PlanEvaluator`."""
        return self.mean.backend

    def at(self, carry: Carry) -> PlanValue:
        """See `PlanEvaluator`."""
        mean = self.mean.at(carry)
        shorter = self.shorter.at(carry) if self.shorter else None

        def plan_value(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            n = self.n
            value = n * mean(actions[..., :n, :], generator)
            if shorter is None:
                return value
            return value - (n - 1) * shorter(actions[..., : n - 1, :], generator)

        return plan_value


def term_evaluator(artifact: Artifact, n: int) -> TermEvaluator:
    """The evaluator of the ``n``-th value, from 1, with the backend of the planner."""

    def mean(steps: int) -> PlanEvaluator[Carry]:
        return make_evaluator(artifact.world_model, replace(artifact.planner, horizon=steps))

    return TermEvaluator(n, mean(n), mean(n - 1) if n > 1 else None)


class TermPolicy(Policy):
    """The policy of an artifact whose planner maximises one of `TERMS`."""

    def __init__(self, artifact: Artifact, term: str, num_envs: int, seed: int) -> None:
        super().__init__(artifact.world_model, artifact.planner, num_envs, seed)
        self._term = term_evaluator(artifact, 1 if term == "first" else artifact.planner.horizon)

    def prepare(self) -> TermEvaluator:
        """See `Policy.prepare`."""
        return self._term


def measure(config: PlanTermsConfig) -> None:
    """Play with each term, and write rewards and spreads."""
    artifact = config.load()
    generator = torch.Generator().manual_seed(config.seed)
    terms = [term_evaluator(artifact, n + 1) for n in range(artifact.planner.horizon)]
    variances: list[Tensor] = []

    def collect(step: study.PlayedStep) -> None:
        """Add the variances of all terms, in the states of both planners."""
        rows = [row for row in step.live if step.tick[row] % _EVERY == 0]
        if rows:
            carry = step.carry.map(lambda x: x[rows])
            sent = torch.as_tensor(step.sent_before[rows], dtype=torch.float32)
            plans = _random_plans(artifact, sent, generator)
            variances.append(torch.stack([t.at(carry)(plans, None).var(1) for t in terms], -1))

    config.write(
        {
            "task": config.task,
            "horizon": artifact.planner.horizon,
            "terms": {term: _play(artifact, config, term, collect) for term in TERMS},
            "return_std": float(artifact.world_model.return_std),
            "spread": torch.cat(variances).mean(0).sqrt().tolist(),
        }
    )


def _play(
    artifact: Artifact,
    config: PlanTermsConfig,
    term: str,
    look: Callable[[study.PlayedStep], None],
) -> dict[str, Any]:
    """Reward, steps and success of each episode; ``look`` sees every step."""
    reward, steps = np.zeros(config.episodes), np.zeros(config.episodes, np.int64)
    success = np.zeros(config.episodes, np.bool_)
    policy = partial(TermPolicy, artifact, term)
    for step in study.play_episodes(artifact, config.env, config, policy, HELD_OUT):
        look(step)
        for row in step.live:
            episode = step.scenarios[row].episode
            reward[episode] += step.result.reward[row]
            steps[episode] += 1
            success[episode] = step.result.success[row]
    return {"reward": reward.tolist(), "steps": steps.tolist(), "success": success.tolist()}


def _random_plans(artifact: Artifact, sent: Tensor, generator: torch.Generator) -> Tensor:
    """(E, M, N, 7) towards uniformly drawn targets from the last actions (E, 7)."""
    config = artifact.planner
    shape = (len(sent), _PLANS, config.horizon, sent.shape[-1])
    deltas = 2 * torch.rand(shape, generator=generator) - 1
    if config.action_parameterization == "target":
        deltas = target_deltas(sent[:, None], deltas, config.eta)
    return random_walk(sent[:, None], deltas, config.eta)


main = study.make_main("plan_terms", PlanTermsConfig, measure)

if __name__ == "__main__":
    raise SystemExit(main())
