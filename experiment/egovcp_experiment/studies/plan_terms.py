"""Closed loop with single terms of the value of a plan instead of their mean (section III-D).

    mean    V = 1/N sum_{k<N} Q(h_k, z^_k, a_k)      (equation 15)
    first   V = Q(h_0, z_0, a_0)
    last    V = Q(h_{N-1}, z^_{N-1}, a_{N-1})

The candidates are plans of N steps in all three, their costs too. If the mean is better because
errors of its terms average out, it is better than each of them. Predicted failures do not count.

Spread: standard deviation of each term over random plans from one state, root mean square over
states. The plans diverge with each step, so later terms differ more between them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from egovcp.artifact import Artifact
from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel
from egovcp.plan import Policy
from egovcp.plan.objective import PlanValue
from egovcp.plan.search import random_walk, target_deltas
from egovcp_experiment.studies import study

#: Name -> V (...) from the values (..., N) of the steps of a plan.
TERMS: Final[Mapping[str, Callable[[Tensor], Tensor]]] = {
    "mean": lambda values: values.mean(-1),
    "first": lambda values: values[..., 0],
    "last": lambda values: values[..., -1],
}
_PLANS: Final = 64  # random plans of a state
_EVERY: Final = 5  # ticks between the states of the spread


@dataclass(frozen=True)
class PlanTermsConfig(study.SimStudyConfig):
    """Play with the mean of Q over a plan, and with its first or last term alone."""

    def load(self) -> Artifact:
        """As `SimStudyConfig.load`; refuses another objective."""
        artifact = super().load()
        if artifact.planner.objective != "value":
            raise UsageError(
                f"--planner.objective={artifact.planner.objective}: expected value, whose terms "
                "are compared"
            )
        return artifact


class TermEvaluator(NamedTuple):
    """A `PlanEvaluator` of one term, or of their mean."""

    model: WorldModel
    term: str

    def at(self, carry: Carry) -> PlanValue:
        """See `PlanEvaluator`."""

        def plan_value(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            values = term_values(self.model, carry, actions)
            return TERMS[self.term](values)

        return plan_value


class TermPolicy(Policy):
    """The policy of an artifact whose planner maximises one term."""

    def __init__(self, artifact: Artifact, term: str, num_envs: int, seed: int) -> None:
        super().__init__(artifact.world_model, artifact.planner, num_envs, seed)
        self._term = term

    def prepare(self) -> TermEvaluator:
        """See `Policy.prepare`."""
        return TermEvaluator(self.model, self._term)


@torch.no_grad()
def term_values(model: WorldModel, carry: Carry, actions: Tensor) -> Tensor:
    """Q of each step of plans (E, M, N, 7) from the states (E, ...), (E, M, N)."""
    state = model.expand_candidates(carry)
    found = []
    for k, action in enumerate(actions.unbind(-2)):
        state = model.imagine(state, actions[..., k - 1, :]) if k else state
        found.append(model.value(state, action))
    return torch.stack(found, -1)


def measure(config: PlanTermsConfig) -> None:
    """Play with each term, and write rewards and spreads."""
    artifact = config.load()
    generator = torch.Generator().manual_seed(config.seed)
    variances: list[Tensor] = []

    def collect(step: study.PlayedStep) -> None:
        """Add the variances of all terms, in the states of all three planners."""
        rows = [row for row in step.live if step.tick[row] % _EVERY == 0]
        if rows:
            carry = step.carry.map(lambda x: x[rows])
            sent = torch.as_tensor(step.env.sent_action[rows], dtype=torch.float32)
            plans = _random_plans(artifact, sent, generator)
            variances.append(term_values(artifact.world_model, carry, plans).var(1))

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
    for step in study.play_episodes(artifact, config.env, config, policy):
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
