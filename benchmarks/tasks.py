"""Difficulty of the tasks for a low-level controller: success and reward of reference policies.

Plays held-out scenarios of each task with `hold` (neutral pose), `constant` (the best fixed action,
searched on other scenarios), `random` (the paper's random walk) and `oracle`, both bands of the
arch's clearance among them, and the wall at one push speed after another with `hold` and `oracle`.
Prints success and reward per step with 95 % intervals, falls, and the way: 0 % is the reward of
`random`, 100 % that of `oracle`. The last line says for which pushes hands at rest mostly fail and
the oracle almost always succeeds. For the wall it also prints how often the oracle stands with free
hands after the push. Run it whenever the controller changes, and put the range of pushes into
`egovcp.sim.config`:

    python benchmarks/tasks.py
    python benchmarks/tasks.py --tasks ball arch wall --pushes
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import batched

import numpy as np
from report import parser, publish

from egovcp.eval_scores import Interval
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import Oracle
from egovcp.sim.scenario import Scenario
from egovcp.spec import PLANNER_DT
from egovcp_deploy.controllers import Action, search_constant
from egovcp_deploy.episodes import EpisodeGroup, EpisodePool, EpisodeSetup
from egovcp_deploy.options import held_out
from egovcp_deploy.scores import EpisodeScore, eval_scores

PLAYERS = ("hold", "constant", "random", "oracle")
PUSHED = ("hold", "oracle")  # for the wall at one push speed after another
BANDS = {"default": (1.16, 1.24), "low": (1.08, 1.16)}
MOST_AT_REST, LEAST_BY_ORACLE = 0.2, 0.9
ENVS = 10
RELEASE_S, NEUTRAL_M = 2.0, 0.10


@dataclass(frozen=True)
class Result:
    """Scores of one player on one task."""

    success: float
    success_ci95: Interval
    reward: float
    """Mean per step."""
    reward_ci95: Interval
    falls: float
    """Share of the episodes that ended in a fall."""
    action: Action = ()
    """Of `constant`: forward, outward, up of the left hand, then of the right one, and height."""


def result(scores: Sequence[EpisodeScore], action: Action = ()) -> Result:
    """The figures of a player's episodes."""
    found = eval_scores(scores)
    return Result(
        success=found.success_rate,
        success_ci95=found.success_interval,
        reward=found.reward_per_step,
        reward_ci95=found.reward_interval,
        falls=sum(score.terminated for score in scores) / len(scores),
        action=action,
    )


def measure(
    env: EnvConfig, task: str, players: Sequence[str], episodes: int, seed: int, workers: int
) -> dict[str, Result]:
    """Player -> figures."""
    scenarios = [held_out(task, seed, i) for i in range(episodes)]
    with closing(EpisodePool(EpisodeSetup(env, seed=seed), workers)) as pool:

        def hold_each(
            actions: Sequence[Action], scenarios: Sequence[Scenario]
        ) -> list[list[EpisodeScore]]:
            parts = list(batched(scenarios, ENVS))
            groups = [EpisodeGroup("constant", part, a) for a in actions for part in parts]
            return [list(scores) for scores in batched(_play(pool, groups), len(scenarios))]

        found = {}
        for name in players:
            action: Action = ()
            if name == "constant":
                action = search_constant(task, seed, hold_each).action
            groups = [EpisodeGroup(name, part, action) for part in batched(scenarios, ENVS)]
            found[name] = result(_play(pool, groups), action)
    return found


def _play(pool: EpisodePool, groups: Sequence[EpisodeGroup]) -> list[EpisodeScore]:
    """Scores in the order of the groups' scenarios."""
    parts = dict(pool.play(groups))
    return [score for i in sorted(parts) for score in parts[i]]


def released(env_config: EnvConfig, episodes: int, seed: int) -> float:
    """Share of the wall's scenarios in which the oracle releases the wall and stays up.

    Both hands must be within `NEUTRAL_M` of their start `RELEASE_S` after the disturbance.
    """
    env = VectorEnv(env_config, episodes, render_depth=False)
    env.reset([held_out("wall", seed, i) for i in range(episodes)])
    oracle, start = Oracle(), env.privileged_state().hands_b
    due = env_config.wall.disturbed_time + RELEASE_S
    free = np.zeros(episodes, np.bool_)
    while not env.done.all():
        result = env.step(oracle.act(env))
        state = env.privileged_state()
        away = np.linalg.norm(state.hands_b - start, axis=-1).max(axis=-1)
        now = np.abs(state.since_event - due) < PLANNER_DT / 2
        free[now] = away[now] < NEUTRAL_M
    return float(np.mean(free & ~result.terminated))


def way(player: str, found: dict[str, Result]) -> float | None:
    """Share of the way from the reward of `random` (0) to that of `oracle` (1).

    None if one of them did not play, or if the oracle does not earn more.
    """
    if not {"random", "oracle"} <= found.keys():
        return None
    low, high = found["random"].reward, found["oracle"].reward
    return (found[player].reward - low) / (high - low) if high > low else None


def rows(name: str, found: dict[str, Result]) -> list[str]:
    """A line per player."""
    lines = []
    for player, r in found.items():
        done = way(player, found)
        (low, high), (least, most) = r.success_ci95, r.reward_ci95
        line = (
            f"{name:<14}{player:<9}{r.success:>7.1%} {f'({low:.0%}-{high:.0%})':<12}"
            f"{r.reward:>+9.4f} {f'({least:+.4f} to {most:+.4f})':<22}{r.falls:>6.0%}"
            f"{'' if done is None else f'{done:.0%}':>7}"
        )
        if r.action:
            line += "  " + " ".join(f"{value:g}" for value in r.action)
        lines.append(line)
    return lines


def figures(name: str, found: dict[str, Result]) -> dict[str, object]:
    """Flat keys."""
    prefix, out = name.replace(" ", "_"), dict[str, object]()
    for player, r in found.items():
        out[f"{prefix}_{player}"] = r.success
        out[f"{prefix}_{player}_reward"] = r.reward
        out[f"{prefix}_{player}_falls"] = r.falls
        done = way(player, found)
        if done is not None:
            out[f"{prefix}_{player}_way"] = done
        if r.action:
            out[f"{prefix}_{player}_action"] = list(r.action)
    return out


def main() -> None:
    """Measure and print."""
    options = parser(__doc__, rounds=None)
    options.add_argument("--controller", default="walk", help="walk, stance, or a file")
    options.add_argument("--episodes", type=int, default=100, help="scenarios of each task")
    options.add_argument("--seed", type=int, default=0, help="seed of the scenarios")
    options.add_argument("--workers", type=int, default=0, help="processes; 0: one per core")
    options.add_argument("--players", nargs="+", choices=PLAYERS, default=PLAYERS)
    options.add_argument(
        "--tasks",
        nargs="*",
        choices=("ball", "arch", "wall"),
        default=("ball", "arch", "wall"),
        help="which tasks at their defaults, the arch in both bands of clearance",
    )
    options.add_argument(
        "--pushes",
        type=float,
        nargs="*",
        default=[0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2],
        help="m/s, speeds at which the wall is also played",
    )
    args = options.parse_args()
    base = replace(evaluation_config(), controller=args.controller)
    published: dict[str, object] = {}

    def measured(name: str, env: EnvConfig, task: str, players: Sequence[str]) -> dict[str, Result]:
        found = measure(env, task, players, args.episodes, args.seed, args.workers)
        published.update(figures(name, found))
        print("\n".join(rows(name, found)), flush=True)
        return found

    print(f"controller {make_controller(args.controller).id}, {args.episodes} episodes each")
    print(
        f"{'task':<14}{'player':<9}{'success':>7} {'95 %':<12}{'reward':>9} {'95 %, per step':<22}"
        f"{'falls':>6}{'way':>7}  best constant action"
    )
    if "ball" in args.tasks:
        measured("ball", base, "ball", args.players)
    for band, clearance in BANDS.items() if "arch" in args.tasks else ():
        arch = replace(base.arch, clearance_range=clearance)
        measured(f"arch {band}", replace(base, arch=arch), "arch", args.players)
    if "wall" in args.tasks:
        measured("wall default", base, "wall", args.players)
        published["wall_released"] = share = released(base, args.episodes, args.seed)
        print(f"wall: oracle stands with free hands {RELEASE_S:g} s after the push: {share:.0%}")
    fair = []
    for speed in args.pushes:
        wall = replace(base.wall, push_speed_range=(speed, speed), away_probability=0.0)
        found = measured(f"wall {speed:.2f} m/s", replace(base, wall=wall), "wall", PUSHED)
        at_rest, oracle = (found[name].success for name in PUSHED)
        if at_rest <= MOST_AT_REST and oracle >= LEAST_BY_ORACLE:
            fair.append(speed)
    if args.pushes:
        span = f"{min(fair)} to {max(fair)} m/s" if fair else "none of these"
        print(f"pushes that hands must and can brace: {span}")
    publish(published, args.json)


if __name__ == "__main__":
    main()
