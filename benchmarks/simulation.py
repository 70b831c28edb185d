"""Planner ticks per second and core: bare simulation, and collection into a LeRobot dataset.

Both simulate the same episodes of one `CollectConfig` with one process per core, in turn, the start
of the processes included. Bare simulation is physics, low-level controller, sensors and depth
camera under the random walk, with nothing recorded; collection is `egovcp-collect` with its
defaults and all that it writes.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy starts its threads

import contextlib
import io
import json
import multiprocessing
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

import mujoco
import numpy as np
from report import parser, publish

from egovcp.data import schema
from egovcp.hardware import available_cores
from egovcp.robot import arms
from egovcp.sim.camera import DepthNoise, RayCastCamera
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp_collect.collect import collect
from egovcp_collect.config import CollectConfig, NewDatasetConfig

ENVS = 16


def make_config(task: str, controller: str, cores: int, groups: int) -> CollectConfig:
    """``groups`` groups of `ENVS` episodes per process, with the defaults of `egovcp-collect`."""
    episodes = cores * groups * ENVS
    config = CollectConfig(task=task, episodes=episodes, num_workers=cores, num_envs=ENVS)
    return replace(config, env=replace(config.env, controller=controller))


def make_simulation(config: CollectConfig) -> tuple[VectorEnv, RandomWalk]:
    policy = RandomWalk(config.eta, config.boundary, config.step_ticks)
    return VectorEnv(config.env, ENVS), policy


def play(env: VectorEnv, policy: RandomWalk, scenarios: Sequence[Scenario]) -> int:
    """Play at least `ENVS` episodes, a finished robot starts the next; returns planner ticks."""
    running, waiting = scenarios[:ENVS], scenarios[ENVS:]
    env.reset(running)
    policy.reset(env, running)
    ticks = 0
    while not env.done.all():
        ticks += int((~env.done).sum())
        env.step(policy.act(env))
        if rows := np.flatnonzero(env.done)[: len(waiting)].tolist():
            started, waiting = waiting[: len(rows)], waiting[len(rows) :]
            env.reset_rows(rows, started)
            policy.reset_rows(rows, started)
    return ticks


def bare_rate(config: CollectConfig) -> tuple[float, float]:
    """Planner ticks per second of all processes together, and the largest peak RSS of one, MiB."""
    start = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(config.num_workers) as pool:
        jobs = [(config, worker) for worker in range(config.num_workers)]
        results = pool.starmap(bare_worker, jobs, chunksize=1)
        seconds = time.perf_counter() - start
    return sum(ticks for ticks, _ in results) / seconds, max(peak for _, peak in results)


def bare_worker(config: CollectConfig, worker: int) -> tuple[int, float]:
    """Planner ticks of one process, and its peak RSS, MiB."""
    ticks = play(*make_simulation(config), config.scenarios()[worker :: config.num_workers])
    return ticks, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # KiB on Linux


def collection_rate(config: CollectConfig) -> float:
    """Planner ticks per second of `egovcp-collect`, all processes together."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        root = Path(folder) / "dataset"
        start = time.perf_counter()
        collect(replace(config, dataset=NewDatasetConfig(root=str(root))))
        seconds = time.perf_counter() - start
        info = json.loads((root / schema.INFO_PATH).read_text(encoding="utf-8"))
    return float(info["total_frames"]) / seconds


def milliseconds_per_tick(config: CollectConfig) -> dict[str, float]:
    """CPU time per planner tick and robot of one process over whole episodes: in total, and of
    the controller (and in it the arms' inverse kinematics), physics, depth images (rays and
    noise) and the rest."""
    env, policy = make_simulation(config)
    scenarios = replace(config, episodes=2 * ENVS).scenarios()
    env.reset(scenarios[:ENVS])  # builds the models
    with timed_parts(env) as spent:
        start = time.thread_time()
        ticks = play(env, policy, scenarios[ENVS:])
        total = time.thread_time() - start
    named = {f"tick_{name}_ms": 1e3 * seconds / ticks for name, seconds in spent.items()}
    named["tick_total_ms"] = 1e3 * total / ticks
    parts = ("controller", "physics", "depth", "depth_noise")
    rest = named["tick_total_ms"] - sum(named[f"tick_{part}_ms"] for part in parts)
    return {**named, "tick_rest_ms": rest}


@contextlib.contextmanager
def timed_parts(env: VectorEnv) -> Iterator[dict[str, float]]:
    """Seconds of CPU spent in each part of ``env`` while the context lasts."""
    places = {
        "controller": (env.controller, "step"),
        "ik": (arms, "ik_step"),
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


def main() -> None:
    p = parser(__doc__)
    p.set_defaults(rounds=3)
    p.add_argument("--task", default="ball", help="ball, wall or arch")
    p.add_argument("--controller", default=CollectConfig().env.controller, help="walk or stance")
    p.add_argument("--groups", type=int, default=8, help="groups of 16 episodes per process")
    args = p.parse_args()
    cores = available_cores()
    config = make_config(args.task, args.controller, cores, args.groups)
    bare: list[float] = []
    collected: list[float] = []
    peak_rss = 0.0
    for _ in range(args.rounds):
        rate, peak = bare_rate(config)
        bare.append(rate / cores)
        peak_rss = max(peak_rss, peak)
        collected.append(collection_rate(config) / cores)
    ratios = [c / b for c, b in zip(collected, bare, strict=True)]
    metrics: dict[str, object] = {
        "task": args.task,
        "controller": args.controller,
        "simulation_ticks_per_s_core": statistics.median(bare),
        "peak_rss_mib": peak_rss,
        "collection_ticks_per_s_core": statistics.median(collected),
        "collection_ratio": statistics.median(ratios),
    }
    publish({**metrics, **milliseconds_per_tick(config)}, args.json)


if __name__ == "__main__":
    main()
