"""Accuracy of the planner backends on recorded states, with a trained policy.

Every backend plans from states of recorded episodes, with the draws of the step-by-step float32
reference. The planner is the policy's, with other numbers of candidates and elites and without
mirrored plans. Metrics: the change of the first action, in normalised units ([-1, 1]), and the loss
of V by the reference, in standard deviations of V among uniformly drawn random walks.
`other_draws` are the same metrics of the reference itself with other random draws.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from report import publish
from torch import Tensor

from egovcp.artifact import load_artifact
from egovcp.data.reader import open_dataset
from egovcp.model import Carry, WorldModel
from egovcp.plan import PlannerConfig, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.plan.backends import make_evaluator
from egovcp.plan.config import BackendName
from egovcp.plan.search import random_walk

BACKENDS: tuple[BackendName, ...] = ("float32", "int8")
BATCH = 8  # robots planned together


def states(model: WorldModel, root: str, episodes: int, every: int) -> tuple[Carry, Tensor]:
    """Filtered states of every ``every``-th row of the last episodes, and the actions before."""
    reader = open_dataset(root)
    carries, before = list[Carry](), []
    for index in range(max(0, len(reader) - episodes), len(reader)):
        episode = reader.read(index)
        depth = torch.from_numpy(episode.depth.astype(np.int32))
        action = torch.from_numpy(np.vstack([0 * episode.action[:1], episode.action[:-1]])).float()
        carry = model.initial(1)
        for t in range(len(depth)):
            state = torch.tensor(episode.state[t : t + 1], dtype=torch.float32)
            first = torch.tensor([t == 0])
            carry = model.observe(carry, action[t : t + 1], depth[t : t + 1], state, first)
            if t % every == every - 1:
                carries.append(carry)
                before.append(action[t : t + 1])
    return Carry.join(carries, torch.cat), torch.cat(before)


class Trial:
    """Plans from the same states, by several backends."""

    def __init__(self, model: WorldModel, config: PlannerConfig, carry: Carry, executed: Tensor):
        self._model, self._config, self._executed, self._carry = model, config, executed, carry
        self._reference = ReferenceEvaluator(model, config)

    def plans(self, backend: BackendName, seed: int) -> Tensor:
        """(S, P, 7), P = `PlannerConfig.actions`."""
        config, discount = replace(self._config, backend=backend), self._model.discount
        evaluator = make_evaluator(self._model, config)
        parts = []
        for rows in torch.arange(len(self._executed)).split(BATCH):
            carry = self._carry.map(lambda x, rows=rows: x[rows])
            search, rng = optimiser_of(config), torch.Generator().manual_seed(seed)
            executed = self._executed[rows]
            plan = make_plan(evaluator, search, carry, executed, config, rng, discount=discount)
            parts.append(plan.actions)
        return torch.cat(parts)

    def plan_value(self, plans: Tensor) -> Tensor:
        """V (S, n) of plans (S, n, P, 7) by the reference."""
        parts = []
        for rows in torch.arange(len(plans)).split(BATCH):
            carry = self._carry.map(lambda x, rows=rows: x[rows])
            rng = torch.Generator().manual_seed(0)  # under latent=sample
            parts.append(self._reference.at(carry)(plans[rows], rng))
        return torch.cat(parts)

    def spread(self) -> Tensor:
        """Standard deviation (S,) of V among uniformly drawn random walks."""
        rng = torch.Generator().manual_seed(0)
        shape = (1, 256, self._config.actions, self._executed.shape[-1])
        steps = 2 * torch.rand(shape, generator=rng) - 1
        every = steps.expand(len(self._executed), -1, -1, -1)
        return self.plan_value(random_walk(self._executed[:, None], every, self._config.eta)).std(1)


@torch.no_grad()
def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--policy", required=True, help="folder of the artifact")
    p.add_argument("--dataset", required=True, help="folder of the dataset")
    p.add_argument("--episodes", type=int, default=20, help="the last ones of the dataset")
    p.add_argument("--every", type=int, default=4, help="a state of every so many rows")
    p.add_argument("--samples", type=int, default=1024, help="M")
    p.add_argument("--json", type=Path, help="also write the metrics to this file")
    args = p.parse_args()
    artifact = load_artifact(args.policy)
    model = artifact.world_model.requires_grad_(False)
    config = replace(artifact.planner, samples=args.samples, elites=min(64, args.samples // 4))
    trial = Trial(model, config, *states(model, args.dataset, args.episodes, args.every))
    reference = trial.plans("eager", 1)
    best, spread = trial.plan_value(reference[:, None])[:, 0], trial.spread()
    metrics: dict[str, object] = {"states": len(reference), "samples": args.samples}
    others = {name: trial.plans(name, 1) for name in BACKENDS}
    for name, plans in {**others, "other_draws": trial.plans("eager", 2)}.items():
        moved = (plans[:, 0] - reference[:, 0]).abs().mean(1)
        lost = (best - trial.plan_value(plans[:, None])[:, 0]) / spread
        metrics |= {
            f"{name}_action_moved_mean": float(moved.mean()),
            f"{name}_action_moved_p95": float(moved.quantile(0.95)),
            f"{name}_value_lost_mean": float(lost.mean()),
            f"{name}_value_lost_p95": float(lost.quantile(0.95)),
        }
    publish(metrics, args.json)


if __name__ == "__main__":
    main()
