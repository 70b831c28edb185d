"""Difficulty of the tasks for a low-level controller: success and reward of reference policies.

Plays held-out scenarios of each task with `hold` (neutral pose), `constant` (the best fixed action,
searched on other scenarios), `random` (the paper's random walk) and `oracle`: the arch at two
ranges of clearance, and the wall also at each of `--pushes` with `hold` and `oracle`. Prints
success and reward per step with 95 % intervals, falls, and the normalized reward (norm.): 0 % is
that of `random`, 100 % that of `oracle`. The last line lists the push speeds where `hold` succeeds
in at most 20 % and `oracle` in at least 90 %. For the wall it also prints how often the oracle
stands with free hands after the push. Run it whenever the low-level controller changes, and set
`push_speed_range` in `egovcp.sim.tasks.wall`:

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
from egovcp_deploy.episodes import EpisodeGroup, EpisodePool
from egovcp_deploy.evaluate import EvalConfig
from egovcp_deploy.options import held_out
from egovcp_deploy.scores import EpisodeScore, eval_scores

TASKS = ("ball", "arch", "wall")
CONTROLLERS = ("hold", "constant", "random", "oracle")
SWEEP_CONTROLLERS = ("hold", "oracle")  # of the wall at each push speed
LOW_CLEARANCE = (1.08, 1.16)  # m, of the arch
MAX_HOLD, MIN_ORACLE = 0.2, 0.9  # success at the push speeds that the last line lists
ENVS = 10
RELEASE_S, NEUTRAL_M = 2.0, 0.10


@dataclass(frozen=True)
class Result:
    """Scores of one controller on one task."""

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
    """The metrics of a controller's episodes."""
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
    env: EnvConfig, task: str, controllers: Sequence[str], episodes: int, seed: int, workers: int
) -> dict[str, Result]:
    """Controller -> metrics."""
    scenarios = [held_out(task, seed, i) for i in range(episodes)]
    config = EvalConfig(env=env, seed=seed, num_workers=workers)
    with closing(EpisodePool(config)) as pool:

        def hold_each(
            actions: Sequence[Action], scenarios: Sequence[Scenario]
        ) -> list[list[EpisodeScore]]:
            parts = list(batched(scenarios, ENVS))
            groups = [EpisodeGroup("constant", part, a) for a in actions for part in parts]
            return [list(scores) for scores in batched(_play(pool, groups), len(scenarios))]

        found = {}
        for name in controllers:
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

    Both hands must be within `NEUTRAL_M` of their start, `RELEASE_S` after the wall's
    `disturbed_time` ends.
    """
    env = VectorEnv(env_config, episodes, render_depth=False)
    env.reset([held_out("wall", seed, i) for i in range(episodes)])
    oracle, start = Oracle(), env.privileged_state().hands_b
    due = env_config.wall.disturbed_time + RELEASE_S
    free = np.zeros(episodes, np.bool_)
    while not env.done.all():
        step = env.step(oracle.act(env))
        state = env.privileged_state()
        away = np.linalg.norm(state.hands_b - start, axis=-1).max(axis=-1)
        now = np.abs(state.since_event - due) < PLANNER_DT / 2
        free[now] = away[now] < NEUTRAL_M
    return float(np.mean(free & ~step.terminated))


def normalized_reward(controller: str, found: dict[str, Result]) -> float | None:
    """Reward scaled so that `random` has 0 and `oracle` 1.

    None if one of them did not play, or if the oracle does not earn more.
    """
    if not {"random", "oracle"} <= found.keys():
        return None
    low, high = found["random"].reward, found["oracle"].reward
    return (found[controller].reward - low) / (high - low) if high > low else None


def rows(name: str, found: dict[str, Result]) -> list[str]:
    """Table row of each controller."""
    lines = []
    for controller, r in found.items():
        normalized = normalized_reward(controller, found)
        (low, high), (least, most) = r.success_ci95, r.reward_ci95
        line = (
            f"{name:<14}{controller:<9}{r.success:>7.1%} {f'({low:.0%}-{high:.0%})':<12}"
            f"{r.reward:>+9.4f} {f'({least:+.4f} to {most:+.4f})':<22}{r.falls:>6.0%}"
            f"{'' if normalized is None else f'{normalized:.0%}':>7}"
        )
        if r.action:
            line += "  " + " ".join(f"{value:g}" for value in r.action)
        lines.append(line)
    return lines


def metrics(name: str, found: dict[str, Result]) -> dict[str, object]:
    """Flat metric name -> value, for `publish`."""
    prefix, out = name.replace(" ", "_").replace("/", "_per_"), dict[str, object]()
    for controller, r in found.items():
        key = f"{prefix}_{controller}"
        out |= {key: r.success, f"{key}_reward": r.reward, f"{key}_falls": r.falls}
        normalized = normalized_reward(controller, found)
        if normalized is not None:
            out[f"{key}_normalized_reward"] = normalized
        if r.action:
            out[f"{key}_action"] = list(r.action)
    return out


def main() -> None:
    """Measure and print."""
    options = parser(__doc__, rounds=None)
    options.add_argument("--controller", default="walk", help="low-level: walk, stance, or a file")
    options.add_argument("--episodes", type=int, default=100, help="scenarios of each task")
    options.add_argument("--seed", type=int, default=0, help="seed of the scenarios")
    options.add_argument("--workers", type=int, default=0, help="processes; 0: one per core")
    options.add_argument(
        "--controllers",
        nargs="+",
        choices=CONTROLLERS,
        default=CONTROLLERS,
        help="controllers to play",
    )
    options.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS, help="tasks to play")
    options.add_argument(
        "--pushes",
        type=float,
        nargs="*",
        default=[0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2],
        help="push speeds at which the wall is also played, m/s; without values: none",
    )
    args = options.parse_args()
    base = replace(evaluation_config(), controller=args.controller)
    published: dict[str, object] = {}

    def measured(
        name: str, env: EnvConfig, task: str, controllers: Sequence[str] = args.controllers
    ) -> dict[str, Result]:
        found = measure(env, task, controllers, args.episodes, args.seed, args.workers)
        published.update(metrics(name, found))
        print("\n".join(rows(name, found)), flush=True)
        return found

    print(f"controller {make_controller(args.controller).id}, {args.episodes} episodes each")
    print(
        f"{'task':<14}{'control':<9}{'success':>7} {'95 %':<12}{'reward':>9} {'95 %, per step':<22}"
        f"{'falls':>6}{'norm.':>7}  best constant action"
    )
    if "ball" in args.tasks:
        measured("ball", base, "ball")
    if "arch" in args.tasks:
        measured("arch default", base, "arch")
        low = replace(base.arch, clearance_range=LOW_CLEARANCE)
        measured("arch low", replace(base, arch=low), "arch")
    if "wall" in args.tasks:
        measured("wall default", base, "wall")
        published["wall_released"] = share = released(base, args.episodes, args.seed)
        after = base.wall.disturbed_time + RELEASE_S
        print(f"wall: oracle stands with free hands {after:g} s after the push: {share:.0%}")
    speeds, suitable = args.pushes if "wall" in args.tasks else [], list[str]()
    for speed in speeds:
        wall = replace(base.wall, push_speed_range=(speed, speed), away_probability=0.0)
        env = replace(base, wall=wall)
        found = measured(f"wall {speed:.2f} m/s", env, "wall", SWEEP_CONTROLLERS)
        if found["hold"].success <= MAX_HOLD and found["oracle"].success >= MIN_ORACLE:
            suitable.append(f"{speed:g}")
    if speeds:
        print(
            f"push speeds where `hold` succeeds in at most {MAX_HOLD:.0%} and `oracle` in at "
            f"least {MIN_ORACLE:.0%}: {', '.join(suitable) or 'none'} m/s"
        )
    publish(published, args.json)


if __name__ == "__main__":
    main()
