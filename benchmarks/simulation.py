"""Planner ticks per second and core: bare simulation, and collection into a LeRobot dataset.

Both run the same episodes with one process per core, in turn. Bare simulation is physics,
low-level controller, sensors and depth camera under the random walk, with nothing recorded;
collection is `egovcp-collect` as a user runs it, disk and the start of its processes included.
"""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import re
import statistics
import tempfile
import time

from report import parser, publish

from egovcp.sim.camera import DepthCamera
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp_collect.collect import main as collect

ENVS = 16


def bare_rate(args: tuple[str, int, int]) -> float:
    """Planner ticks per second of one process over ``groups`` groups of episodes."""
    task, worker, groups = args
    env, policy = VectorEnv(EnvConfig(), ENVS), RandomWalk()
    env.reset([Scenario(task, 0, i) for i in range(ENVS)])  # builds the models
    ticks, start = 0, time.perf_counter()
    for group in range(groups):
        first = (worker * groups + group) * ENVS
        scenarios = [Scenario(task, 1, first + i) for i in range(ENVS)]
        env.reset(scenarios)
        policy.reset(env, scenarios)
        while not env.done.all():
            ticks += int((~env.done).sum())
            env.step(policy.act(env))
    return ticks / (time.perf_counter() - start)


def collection_rate(task: str, cores: int, episodes: int) -> float:
    """Planner ticks per second of `egovcp-collect`, all processes together, as it prints it."""
    output = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(output):
        code = collect(
            [
                f"--task={task}",
                "--dataset.repo_id=bench/rate",
                f"--dataset.root={folder}/dataset",
                f"--episodes={episodes}",
                f"--num_workers={cores}",
                f"--num_envs={ENVS}",
            ]
        )
    found = re.search(r"([\d.]+) steps/s", output.getvalue())
    if code or not found:
        raise SystemExit(f"egovcp-collect failed with exit code {code}: {output.getvalue()}")
    return float(found[1])


def milliseconds_per_tick(task: str, ticks: int) -> dict[str, float]:
    """What the controller and the camera cost per planner tick and robot, one process."""
    env, policy = VectorEnv(EnvConfig(), ENVS), RandomWalk()
    scenarios = [Scenario(task, 0, i) for i in range(ENVS)]
    env.reset(scenarios)
    policy.reset(env, scenarios)
    spent = {"controller": 0.0, "depth": 0.0}

    def timed(name: str, function):  # type: ignore[no-untyped-def]
        def wrapper(*args, **kwargs):  # type: ignore[no-untyped-def]
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                spent[name] += time.perf_counter() - start

        return wrapper

    env.controller.step = timed("controller", env.controller.step)  # type: ignore[method-assign]
    original = DepthCamera.render
    DepthCamera.render = timed("depth", original)  # type: ignore[method-assign]
    try:
        start = time.perf_counter()
        for _ in range(ticks):
            env.step(policy.act(env))
        total = time.perf_counter() - start
    finally:
        DepthCamera.render = original  # type: ignore[method-assign]
    parts = {f"tick_{name}_ms": 1e3 * s / (ticks * ENVS) for name, s in spent.items()}
    rest = 1e3 * (total - sum(spent.values())) / (ticks * ENVS)
    return {**parts, "tick_physics_and_rest_ms": rest}


def main() -> None:
    p = parser(__doc__)
    p.set_defaults(rounds=3)
    p.add_argument("--task", default="ball", help="ball, wall or arch")
    p.add_argument("--groups", type=int, default=8, help="groups of 16 episodes per process")
    args = p.parse_args()
    cores = len(os.sched_getaffinity(0))
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    bare: list[float] = []
    collected: list[float] = []
    jobs = [(args.task, worker, args.groups) for worker in range(cores)]
    with multiprocessing.get_context("spawn").Pool(cores) as pool:
        for _ in range(args.rounds):
            bare.append(sum(pool.map(bare_rate, jobs, chunksize=1)) / cores)
            episodes = cores * args.groups * ENVS
            collected.append(collection_rate(args.task, cores, episodes) / cores)
    ratios = [c / b for c, b in zip(collected, bare, strict=True)]
    publish(
        {
            "task": args.task,
            "simulation_ticks_per_s_core": statistics.median(bare),
            "collection_ticks_per_s_core": statistics.median(collected),
            "collection_ratio": statistics.median(ratios),
            **milliseconds_per_tick(args.task, 40),
        },
        args.json,
    )


if __name__ == "__main__":
    main()
