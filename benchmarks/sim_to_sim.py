"""Survival of a low-level controller in physics outside or at the edge of the training ranges.

Plays the skills of `egovcp-eval-lowlevel` in each variant, with the robots, commands and pushes
of the reference (stock feet, 5 ms steps, the default ranges of `egovcp-eval-lowlevel
--disturbances`). Prints the survival in the reference and, per variant, its difference in
percentage points, drops of more than 3 marked *; then the worst difference of each variant with
its 95 % interval, paired by robot.

    python benchmarks/sim_to_sim.py --controller walk --episodes 400
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from report import parser, publish

from egovcp.eval_scores import Interval, bootstrap
from egovcp.hardware import available_cores
from egovcp.robot.controllers import make_controller
from egovcp.robot.mjcf import FootModel
from egovcp.sim.config import SensorConfig
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.physics import PhysicsOptions
from egovcp_train.lowlevel.skills import SKILLS, Skill
from egovcp_train.lowlevel.trial import play

type Survived = NDArray[np.bool_]
_MAX_DROP_POINTS: Final = 3.0  # larger drops are marked *
_BATCH: Final = 200  # robots side by side
_NOT_PLAYED: Final = ("still", "rest")  # robots that nothing disturbs


@dataclass(frozen=True)
class Variant:
    """Physics; by default the reference."""

    feet: FootModel = "stock"
    options: PhysicsOptions = field(default_factory=PhysicsOptions)
    disturbances: DisturbanceConfig = field(default_factory=lambda: DisturbanceConfig(models=400))


def _with(**changes: tuple[float, float]) -> Variant:
    return Variant(disturbances=replace(Variant().disturbances, **changes))


VARIANTS: Final[Mapping[str, Variant]] = {
    "point feet": Variant(feet="points"),
    "2 ms steps": Variant(options=PhysicsOptions(timestep=0.002)),
    "elliptic cone": Variant(options=PhysicsOptions(cone="elliptic")),
    # Explicit integration of the servos' damping is unstable with 5 ms and gains of +20 %.
    "Euler 2 ms": Variant(options=PhysicsOptions(integrator="Euler", timestep=0.002)),
    "payload 3 kg": _with(payload=(3.0, 3.0)),
    "friction 0.4": _with(friction=(0.4, 0.4)),
    "gains -20 %": _with(stiffness_scale=(0.8, 0.8), damping_scale=(0.8, 0.8)),
    "gains +20 %": _with(stiffness_scale=(1.2, 1.2), damping_scale=(1.2, 1.2)),
    "delay to 30 ms": _with(delay=(0.0, 0.03)),
}


def survived(
    controller: str, skill: Skill, variant: Variant, episodes: int, seed: int, threads: int
) -> Survived:
    """(episodes,) which robots were still up at the end."""
    parts = []
    for first in range(0, episodes, _BATCH):
        outcome = play(
            make_controller(controller),
            skill,
            min(_BATCH, episodes - first),
            seed + first,
            variant.disturbances,
            SensorConfig(),
            variant.feet,
            threads,
            options=variant.options,
        )
        parts.append(outcome.survived)
    return np.concatenate(parts)


def difference(variant: Survived, reference: Survived) -> tuple[float, Interval]:
    """Percentage points, and their 95 % interval over robots."""
    each = 100.0 * (variant.astype(np.float64) - reference)
    low, high = bootstrap(lambda picks: each[picks].mean(axis=1), len(each))
    return float(each.mean()), (low, high)


def row(name: str, values: Sequence[float], signed: bool = True) -> str:
    """A line of the table; drops of more than `_MAX_DROP_POINTS` are marked *."""
    cells = []
    for value in values:
        star = "*" if signed and value < -_MAX_DROP_POINTS else " "
        cells.append(f"{f'{value:+.1f}' if signed else f'{value:.1f}':>7}{star}")
    return f"{name:<15}" + "".join(cells)


def main() -> None:
    """Measure and print."""
    skills = {skill.name: skill for skill in SKILLS if skill.name not in _NOT_PLAYED}
    options = parser(__doc__, rounds=None)
    options.add_argument("--controller", default="walk", help="walk, stance, or a file")
    options.add_argument("--episodes", type=int, default=100, help="robots of each skill")
    options.add_argument("--seed", type=int, default=1000, help="seed of robots and commands")
    options.add_argument("--threads", type=int, default=0, help="physics threads; 0: one per core")
    for flag, names in (("--skills", tuple(skills)), ("--variants", tuple(VARIANTS))):
        options.add_argument(flag, nargs="+", choices=names, default=names, help="which to play")
    args = options.parse_args()
    threads = args.threads or available_cores()

    def measured(variant: Variant) -> dict[str, Survived]:
        return {
            name: survived(
                args.controller, skills[name], variant, args.episodes, args.seed, threads
            )
            for name in args.skills
        }

    print(f"controller {make_controller(args.controller).id}, {args.episodes} robots each")
    print(f"{'survival, %':<15}" + "".join(f"{name[:7]:>7} " for name in args.skills))
    reference = measured(Variant())
    shares = {name: float(up.mean()) for name, up in reference.items()}
    print(row("reference", [100 * share for share in shares.values()], signed=False), flush=True)
    published: dict[str, object] = {f"reference_{name}": share for name, share in shares.items()}
    worst = []
    for title in args.variants:
        found = measured(VARIANTS[title])
        apart = {name: difference(found[name], reference[name]) for name in args.skills}
        print(row(title, [points for points, _ in apart.values()]), flush=True)
        key = title.replace(" ", "_")
        for name, (points, interval) in apart.items():
            published[f"{key}_{name}"] = float(found[name].mean())
            published[f"{key}_{name}_points"] = points
            published[f"{key}_{name}_points_ci95"] = list(interval)
        name = min(apart, key=lambda skill: apart[skill][0])
        points, (low, high) = apart[name]
        worst.append(f"{title:<15}{name:<10}{points:+.1f} ({low:+.1f} to {high:+.1f})")
    print(
        "worst skill of each variant, points, with the interval of that skill alone:\n"
        + "\n".join(worst)
    )
    publish(published, args.json)


if __name__ == "__main__":
    main()
