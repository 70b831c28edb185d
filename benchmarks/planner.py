"""Milliseconds per plan of every backend, against plain eager PyTorch of the same mathematics.

The plain one follows equation 15: every candidate has a copy of the state, and every step runs
every network, in float32. All have the same weights; those on the CPU have the same random draws.
All backends on the CPU have the search of `auto`.

    python benchmarks/planner.py --rounds 100

`arithmetic_share` is a backend's rate, counting only the arithmetic that a plan needs, relative to
a plain matrix product of the same precision in the same run. `observe` is the filter's step;
`command` is from an observation to the action, with the backend of `auto`. `gpu_eager` and
`gpu_float32` are plans on a GPU, if there is one, up to the action in CPU memory; `gpu_float32`
replays a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from report import interleaved_times, parser, publish
from torch import Tensor, nn

from egovcp import spec
from egovcp.model import Carry, WorldModel, WorldModelConfig
from egovcp.plan import PlanEvaluator, PlannerConfig, Policy, make_plan, optimiser_of
from egovcp.plan.backends import make_evaluator
from egovcp.plan.config import PAPER_PLANNER, BackendName
from egovcp.plan.search import reflect_once

SIDE = 1024  # of the matrices of the plain product


def plain_plan(
    model: WorldModel, carry: Carry, executed: Tensor, config: PlannerConfig, seed: int
) -> Tensor:
    """First action (7,) of the plan for one robot.

    Only CEM with ``termination_rule=shift``: the action costs, mirrored plans and target actions of
    the shipped planner are omitted.
    """
    generator = torch.Generator().manual_seed(seed)
    m, n = config.samples, config.horizon
    mean, std = torch.zeros(n, spec.ACTION_DIM), torch.full((n, spec.ACTION_DIM), 3.0**-0.5)
    for _ in range(config.iterations):
        noise = torch.randn((1, m, n, spec.ACTION_DIM), generator=generator)[0]
        deltas = mean + std * noise
        deltas[0], deltas[1] = mean, 0.0
        deltas = deltas.clamp(-1, 1)
        state = carry.map(lambda x: x.repeat(m, 1))
        action = executed.repeat(m, 1)
        values, alive = [], torch.ones(m)
        for k in range(n):
            action = reflect_once(action + config.eta * deltas[:, k])
            values.append(alive * (model.value(state, action) - model.min_return))
            if k > 0:
                alive = alive * (model.termination(state) <= config.termination_threshold)
            state = model.imagine(state, action)
        elites = deltas[torch.stack(values).mean(0).topk(config.elites).indices]
        mean, std = elites.mean(0), elites.std(0, correction=0).clamp_min(config.min_std)
    return reflect_once(executed[0] + config.eta * mean[0])


def needed_gflop(model: WorldModel, config: PlannerConfig) -> float:
    """Arithmetic of one plan: multiplications and additions of matrix products, without those that
    all candidates share at k = 0, of the prior's standard deviation, and after the last step."""

    def macs(*modules: nn.Module) -> int:
        linears = [x for m in modules for x in m.modules()]
        return sum(x.weight.numel() for x in linears if isinstance(x, nn.Linear))

    q_later = macs(model.value_head)
    q_start = q_later - macs(*list(model.value_head.first.parts)[:-1])
    prior = macs(model.prior) - model.config.latent * model.config.units
    first = macs(model.mix.parts[1], model.gru.project.parts[0])
    later = macs(model.mix, model.gru)
    n = config.horizon
    each = q_start + (n - 1) * (q_later + prior) + max(n - 2, 0) * macs(model.termination_head)
    each += (first if n > 1 else 0) + max(n - 2, 0) * later
    return 2e-9 * each * config.samples * config.iterations


def gpu_plans(
    model: WorldModel, carry: Carry, executed: Tensor, config: PlannerConfig
) -> dict[str, Callable[[], Tensor]]:
    """Name -> a plan's first action on a GPU; nothing without one."""
    if not torch.cuda.is_available():
        return {}
    gpu_model, last_action = deepcopy(model).cuda(), executed.cuda()
    state = carry.map(lambda x: x.cuda())

    def planned(evaluator: PlanEvaluator[Carry]) -> Callable[[], Tensor]:
        def run() -> Tensor:
            generator = torch.Generator("cuda").manual_seed(1)
            search = optimiser_of(config, "cuda")
            plan = make_plan(evaluator, search, state, last_action, config, generator)
            return plan.actions[0, 0].cpu()  # waits for it

        return run

    names: tuple[BackendName, ...] = ("eager", "float32")
    return {
        f"gpu_{name}": planned(make_evaluator(gpu_model, replace(config, backend=name)))
        for name in names
    }


def plain_products() -> dict[str, Callable[[], object]]:
    """Precision -> a product of two square matrices, by the fastest call that torch has."""
    a, b = torch.randn(SIDE, SIDE), torch.randn(SIDE, SIDE)
    weight = torch.randint(-127, 128, (SIDE, SIDE), dtype=torch.int8)
    packed = torch.ops.onednn.qlinear_prepack(weight, [SIDE, SIDE])
    rows = torch.randint(0, 256, (SIDE, SIDE), dtype=torch.uint8)
    scale, zero = torch.ones(SIDE), torch.zeros(SIDE, dtype=torch.int32)
    return {
        "float32": lambda: a @ b,
        "int8": lambda: torch.ops.onednn.qlinear_pointwise(
            rows, 1.0, 0, packed, scale, zero, None, 1.0, 0, torch.float32, "none", [], ""
        ),
    }


@torch.no_grad()
def main() -> None:
    p = parser(__doc__)
    p.add_argument("--samples", type=int, default=1024, help="candidates per iteration, M")
    args = p.parse_args()
    torch.manual_seed(0)
    model = WorldModel(WorldModelConfig()).eval().requires_grad_(False)
    torch.nn.init.normal_(model.value_head.rest[-1].weight, std=0.1)  # type: ignore[arg-type]
    elites = min(64, args.samples // 4)
    config = replace(PAPER_PLANNER, samples=args.samples, elites=elites, termination_rule="shift")
    h, z = torch.randn(1, model.config.hidden).tanh(), torch.randn(1, model.config.latent)
    carry = Carry(h, z)
    executed = torch.zeros(1, spec.ACTION_DIM)

    def planned(evaluator: PlanEvaluator[Carry]) -> Callable[[], Tensor]:
        def run() -> Tensor:
            generator = torch.Generator().manual_seed(1)
            search = optimiser_of(config)
            return make_plan(evaluator, search, carry, executed, config, generator).actions[0, 0]

        return run

    names: tuple[BackendName, ...] = ("auto", "eager", "float32", "int8")
    plans = {name: planned(make_evaluator(model, replace(config, backend=name))) for name in names}

    def plain() -> Tensor:
        return plain_plan(model, carry, executed, config, 1)

    on_gpu = gpu_plans(model, carry, executed, config)
    differences = {name: float((plan() - plain()).abs().max()) for name, plan in plans.items()}
    policy = Policy(model, config, num_envs=1)
    depth = np.full((1, spec.DEPTH_ROWS, spec.DEPTH_COLS), 2000, np.uint16)
    state = np.zeros((1, spec.STATE_DIM), np.float32)
    seen = (torch.from_numpy(depth.astype(np.int32)), torch.from_numpy(state))
    is_first = torch.zeros(1, dtype=torch.bool)
    products = plain_products()
    cases: dict[str, Callable[[], object]] = {
        **{f"plan_{name}": plan for name, plan in plans.items()},
        **on_gpu,
        "plain": plain,
        "observe": lambda: model.observe(carry, executed, *seen, is_first),
        "command": lambda: policy.act(depth, state),
        **{f"product_{name}": product for name, product in products.items()},
    }
    times = interleaved_times(cases, args.rounds)
    p50 = {name: values[len(values) // 2] for name, values in times.items()}
    p99 = {name: float(np.percentile(values, 99)) for name, values in times.items()}
    gflop = needed_gflop(model, config)
    rate = {name: 2e-9 * SIDE**3 / p50[f"product_{name}"] for name in products}
    metrics: dict[str, object] = {
        "plan_ms": 1e3 * p50["plan_auto"],
        "plan_ms_p99": 1e3 * p99["plan_auto"],
        "plan_plain_eager_ms": 1e3 * p50["plain"],
        "plan_ratio": p50["plain"] / p50["plan_auto"],
        "needed_gflop": gflop,
    }
    for name in plans:
        if name == "auto":
            continue
        seconds = p50[f"plan_{name}"]
        metrics[f"{name}_ms"] = 1e3 * seconds
        metrics[f"{name}_ms_p99"] = 1e3 * p99[f"plan_{name}"]
        metrics[f"{name}_ratio"] = p50["plain"] / seconds
        metrics[f"{name}_action_difference"] = differences[name]
        metrics[f"{name}_gflops"] = gflop / seconds
        if name in rate:
            metrics[f"{name}_arithmetic_share"] = gflop / seconds / rate[name]
    for name in products:
        metrics[f"product_{name}_gflops"] = rate[name]
    for name in ("observe", "command", *on_gpu):
        metrics[f"{name}_ms"], metrics[f"{name}_ms_p99"] = 1e3 * p50[name], 1e3 * p99[name]
    shape = {"samples": config.samples, "horizon": config.horizon, "iterations": config.iterations}
    publish(metrics | shape, args.json)


if __name__ == "__main__":
    main()
