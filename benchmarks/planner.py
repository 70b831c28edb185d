"""Milliseconds per plan, against a plain eager PyTorch implementation of the same mathematics.

The plain one writes equation 15 down: every candidate carries its own copy of the state, and
every step runs every network. Both are fp32 on the CPU with the same weights and random draws,
and must choose the same action.
"""

from __future__ import annotations

import torch
from report import interleaved, parser, publish
from torch import Tensor

from egovcp import spec
from egovcp.model import Carry, WorldModel, WorldModelConfig
from egovcp.plan import PlannerConfig, plan_cem
from egovcp.plan.cem import reflect


def plain_plan(
    model: WorldModel, carry: Carry, executed: Tensor, config: PlannerConfig, seed: int
) -> Tensor:
    """First action (7,) of the plan for one robot."""
    generator = torch.Generator().manual_seed(seed)
    m, n = config.samples, config.horizon
    mean, std = torch.zeros(n, spec.ACTION_DIM), torch.full((n, spec.ACTION_DIM), 3.0**-0.5)
    for _ in range(config.iterations):
        noise = torch.randn((1, m, n, spec.ACTION_DIM), generator=generator)[0]
        deltas = mean + std * noise
        deltas[0], deltas[1] = mean, 0.0
        deltas = deltas.clamp(-1, 1)
        state = Carry(carry.h.repeat(m, 1), carry.z.repeat(m, 1))
        action = executed.repeat(m, 1)
        values, alive = [], torch.ones(m)
        for k in range(n):
            action = reflect(action + config.eta * deltas[:, k])
            values.append(alive * (model.value(state, action) - model.return_floor))
            if k > 0:
                alive = alive * (model.termination(state) <= config.termination_threshold)
            state = model.imagine(state, action)
        elites = deltas[torch.stack(values).mean(0).topk(config.elites).indices]
        mean, std = elites.mean(0), elites.std(0, correction=0).clamp_min(config.min_std)
    return reflect(executed[0] + config.eta * mean[0])


@torch.no_grad()
def main() -> None:
    p = parser(__doc__)
    p.add_argument("--samples", type=int, default=1024, help="M")
    args = p.parse_args()
    torch.manual_seed(0)
    model = WorldModel(WorldModelConfig()).eval()
    torch.nn.init.normal_(model.value_head.mlp.rest[-1].weight, std=0.1)
    config = PlannerConfig(samples=args.samples, elites=min(64, args.samples // 4))
    carry = Carry(torch.randn(1, model.config.hidden), torch.randn(1, model.config.latent))
    executed = torch.zeros(1, spec.ACTION_DIM)

    def ours() -> Tensor:
        generator = torch.Generator().manual_seed(1)
        return plan_cem(model, carry, executed, config, generator).actions[0, 0]

    def plain() -> Tensor:
        return plain_plan(model, carry, executed, config, 1)

    difference = float((ours() - plain()).abs().max())
    seconds = interleaved({"plan": ours, "plain": plain}, args.rounds)
    publish(
        {
            "plan_ms": 1e3 * seconds["plan"],
            "plan_plain_eager_ms": 1e3 * seconds["plain"],
            "plan_ratio": seconds["plain"] / seconds["plan"],
            "action_difference": difference,
            "samples": config.samples,
            "horizon": config.horizon,
            "iterations": config.iterations,
        },
        args.json,
    )


if __name__ == "__main__":
    main()
