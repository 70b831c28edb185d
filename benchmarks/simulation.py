"""Planner ticks per second and core: bare simulation, and collection into a LeRobot dataset.

Both run as many episodes with one process per core, in turn, the start of the processes included.
Bare simulation is physics, low-level controller, sensors and depth camera under the random walk,
with nothing recorded; collection is `egovcp-collect` as a user runs it, with all that it writes.
"""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import re
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from unittest import mock

import mujoco
from report import parser, publish

from egovcp.hardware import available_cores
from egovcp.robot import arms
from egovcp.sim.camera import DepthNoise, RayCastCamera
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp_collect.collect import main as collect

ENVS = 16


def bare_rate(task: str, controller: str, cores: int, groups: int) -> tuple[float, float]:
    """Planner ticks per second of all processes together, and the peak memory of one, MB."""
    start = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(cores) as pool:
        jobs = [(task, controller, worker, groups) for worker in range(cores)]
        ticks = sum(pool.map(bare_ticks, jobs, chunksize=1))
        return ticks / (time.perf_counter() - start), pool.apply(resident_megabytes)


def bare_ticks(args: tuple[str, str, int, int]) -> int:
    """Planner ticks that one process does in ``groups`` groups of episodes."""
    task, controller, worker, groups = args
    env, policy = VectorEnv(replace(EnvConfig(), controller=controller), ENVS), RandomWalk()
    ticks = 0
    for group in range(groups):
        first = (worker * groups + group) * ENVS
        scenarios = [Scenario(task, 1, first + i) for i in range(ENVS)]
        env.reset(scenarios)
        policy.reset(env, scenarios)
        while not env.done.all():
            ticks += int((~env.done).sum())
            env.step(policy.act(env))
    return ticks


def collection_rate(task: str, controller: str, cores: int, episodes: int) -> float:
    """Planner ticks per second of `egovcp-collect`, all processes together, as it prints it."""
    output = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(output):
        code = collect(
            [
                f"--task={task}",
                f"--dataset.root={folder}/dataset",
                f"--env.controller={controller}",
                f"--episodes={episodes}",
                f"--num_workers={cores}",
                f"--num_envs={ENVS}",
            ]
        )
    found = re.search(r"([\d.]+) steps/s", output.getvalue())
    if code or not found:
        raise SystemExit(f"egovcp-collect failed with exit code {code}: {output.getvalue()}")
    return float(found[1])


def milliseconds_per_tick(task: str, controller: str, groups: int = 1) -> dict[str, float]:
    """CPU time per planner tick and robot of one process over whole episodes: in total, and of
    the controller (and in it the arms' inverse kinematics), physics, depth images (rays and
    noise) and the rest."""
    env, policy = VectorEnv(replace(EnvConfig(), controller=controller), ENVS), RandomWalk()
    env.reset([Scenario(task, 0, i) for i in range(ENVS)])  # builds the models
    with timed_parts(env) as spent:
        ticks, start = 0, time.thread_time()
        for group in range(groups):
            scenarios = [Scenario(task, 2, group * ENVS + i) for i in range(ENVS)]
            env.reset(scenarios)
            policy.reset(env, scenarios)
            while not env.done.all():
                ticks += int((~env.done).sum())
                env.step(policy.act(env))
        total = time.thread_time() - start
    named = {f"tick_{name}_ms": 1e3 * seconds / ticks for name, seconds in spent.items()}
    named["tick_total_ms"] = 1e3 * total / ticks
    parts = ("controller", "physics", "depth", "depth_noise")
    rest = named["tick_total_ms"] - sum(named[f"tick_{part}_ms"] for part in parts)
    return {
        **named,
        "tick_rest_ms": rest,
        "tick_physics_and_rest_ms": named["tick_physics_ms"] + rest,
    }


@contextlib.contextmanager
def timed_parts(env: VectorEnv) -> Iterator[dict[str, float]]:
    """Seconds of CPU spent in each part of ``env`` while the context lasts."""
    places = {
        "controller": (env.controller, "step"),
        "ik": (arms, "improve"),
        "physics": (mujoco, "mj_step"),
        "depth": (RayCastCamera, "render"),
        "depth_noise": (DepthNoise, "apply"),
    }
    spent = dict.fromkeys(places, 0.0)
    with contextlib.ExitStack() as stack:
        for name, (owner, method) in places.items():
            timed = _timed(getattr(owner, method), spent, name)
            stack.enter_context(mock.patch.object(owner, method, timed))
        yield spent


def _timed(
    function: Callable[..., object], spent: dict[str, float], name: str
) -> Callable[..., object]:
    def wrapper(*args: object, **kwargs: object) -> object:
        start = time.thread_time()
        try:
            return function(*args, **kwargs)
        finally:
            spent[name] += time.thread_time() - start

    return wrapper


def resident_megabytes() -> float:
    """Peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # kB on Linux


def main() -> None:
    p = parser(__doc__)
    p.set_defaults(rounds=3)
    p.add_argument("--task", default="ball", help="ball, wall or arch")
    p.add_argument("--controller", default=EnvConfig().controller, help="walk or stance")
    p.add_argument("--groups", type=int, default=8, help="groups of 16 episodes per process")
    args = p.parse_args()
    cores = available_cores()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    bare: list[float] = []
    collected: list[float] = []
    for _ in range(args.rounds):
        rate, resident = bare_rate(args.task, args.controller, cores, args.groups)
        bare.append(rate / cores)
        episodes = cores * args.groups * ENVS
        rate = collection_rate(args.task, args.controller, cores, episodes)
        collected.append(rate / cores)
    ratios = [c / b for c, b in zip(collected, bare, strict=True)]
    figures: dict[str, object] = {
        "task": args.task,
        "controller": args.controller,
        "simulation_ticks_per_s_core": statistics.median(bare),
        "simulation_resident_mb": resident,
        "collection_ticks_per_s_core": statistics.median(collected),
        "collection_ratio": statistics.median(ratios),
    }
    publish({**figures, **milliseconds_per_tick(args.task, args.controller)}, args.json)


if __name__ == "__main__":
    main()
