"""How hard the tasks are for a low-level controller: hands at rest against the scripted oracle.

Plays held-out scenarios of each task with `hold` and `oracle`, the wall at one push speed after
another, the arch in both bands of clearance. A task is well set for a controller when hands at
rest mostly fail and the oracle almost always succeeds; the last line says for which pushes that is
so. Run it whenever the controller changes, and put the range into `egovcp.sim.config`:

    python benchmarks/tasks.py --controller stance
    python benchmarks/tasks.py --controller walk
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from itertools import batched

from report import parser, publish

from egovcp.intervals import wilson
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import EnvConfig, eventful
from egovcp_deploy.episodes import Group, Setup, Stage
from egovcp_deploy.scenarios import held_out

PLAYERS = ("hold", "oracle")
BANDS = {"default": (1.16, 1.24), "low": (1.08, 1.16)}
MOST_AT_REST, LEAST_BY_ORACLE = 0.2, 0.9
ENVS = 10


def rates(env: EnvConfig, task: str, episodes: int, seed: int) -> dict[str, float]:
    """Share of successes of each player."""
    scenarios = [held_out(task, seed, i) for i in range(episodes)]
    groups = [Group(name, part) for name in PLAYERS for part in batched(scenarios, ENVS)]
    won = dict.fromkeys(PLAYERS, 0)
    with closing(Stage(Setup(env, seed=seed))) as stage:
        for i, scores in stage.play(groups):
            won[groups[i].controller] += sum(score.success for score in scores)
    return {name: wins / episodes for name, wins in won.items()}


def show(name: str, found: dict[str, float], episodes: int) -> dict[str, float]:
    """Print a row and name its figures."""
    cells = []
    for player, rate in found.items():
        low, high = wilson(round(rate * episodes), episodes)
        cells.append(f"{player} {rate:6.1%} ({low:.0%}-{high:.0%})")
    print(f"{name:24s} " + "   ".join(cells), flush=True)
    return {f"{name.replace(' ', '_')}_{player}": rate for player, rate in found.items()}


def main() -> None:
    """Measure and print."""
    options = parser(__doc__)
    options.add_argument("--controller", default="walk", help="walk, stance, or a file")
    options.add_argument("--episodes", type=int, default=100)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument(
        "--pushes", type=float, nargs="*", default=[0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2]
    )
    args = options.parse_args()
    base = replace(eventful(), controller=args.controller)
    n, figures = args.episodes, {}

    def measured(name: str, env: EnvConfig, task: str) -> dict[str, float]:
        found = rates(env, task, n, args.seed)
        figures.update(show(name, found, n))
        return found

    print(f"controller {make_controller(args.controller).id}, {n} episodes each")
    measured("ball", base, "ball")
    for band, clearance in BANDS.items():
        arch = replace(base.arch, clearance_range=clearance)
        measured(f"arch {band}", replace(base, arch=arch), "arch")
    measured("wall default", base, "wall")
    fair = []
    for speed in args.pushes:
        wall = replace(base.wall, push_speed_range=(speed, speed), away_probability=0.0)
        found = measured(f"wall {speed:.2f} m/s", replace(base, wall=wall), "wall")
        if found["hold"] <= MOST_AT_REST and found["oracle"] >= LEAST_BY_ORACLE:
            fair.append(speed)
    span = f"{min(fair)} to {max(fair)} m/s" if fair else "none of these"
    print(f"pushes that hands must and can brace: {span}")
    publish(figures, args.json)


if __name__ == "__main__":
    main()
