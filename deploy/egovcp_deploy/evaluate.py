"""`egovcp-eval`: the planner and its references on the same held-out scenarios."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from itertools import batched, chain
from pathlib import Path
from typing import Any, Final

import numpy as np
from tqdm import tqdm

from egovcp.bounds import MAX_PER_CORE, bounded
from egovcp.cli import run_command
from egovcp.errors import UsageError, suggest
from egovcp.files import user_path, write_json
from egovcp.hardware import available_cores
from egovcp.packages import require_packages
from egovcp.policy_options import PlannerOptions, PolicyOptions, load_policy
from egovcp.reactive import ReactiveNetwork
from egovcp.sim.config import EnvConfig, evaluation_config, require_memory_for_robots
from egovcp.sim.env import resolve_config
from egovcp.sim.robot_env import controller_id_of
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.registry import DEFAULT_TASK, find_task, select_tasks
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_deploy.controllers import (
    CONSTANT,
    DEFAULT_CONTROLLERS,
    PPO,
    Action,
    BestConstant,
    load_constants,
    search_constant,
)
from egovcp_deploy.episodes import EpisodeGroup, EpisodePool
from egovcp_deploy.options import (
    PLANNER,
    SEEDS,
    check_output_dir,
    encoded,
    evaluation_versions,
    held_out,
    make_output_dir,
)
from egovcp_deploy.pilot.planner import backend_of
from egovcp_deploy.scores import EpisodeScore, summary, table

PROG: Final = "egovcp-eval"
_EPILOG: Final = (
    "All controllers play the same scenarios, which are never used for training data (their seeds "
    "are offset), each with an event: no empty scenes unless --env.*_episode.empty_probability is "
    "set. `egovcp-task list` describes the tasks; the rates of the parts of a sequence are listed "
    "below it. 'constant' is the best fixed action of a grid, found on other scenarios. plan_ms "
    "is the time per robot when num_envs robots are planned together; --num_envs=1 "
    "--num_workers=1 gives the latency of one. Writes eval.json (metrics), eval_run.json (config "
    "and every episode) and constant.json. Ctrl-C saves the finished episodes; the result files "
    "are marked incomplete."
)

type Scores = dict[str, dict[str, list[EpisodeScore]]]


@dataclass(frozen=True)
class ConstantOptions:
    """The reference `constant`."""

    path: str = ""
    """constant.json of an earlier evaluation; empty: search for the best action."""


@dataclass(frozen=True)
class PpoOptions:
    """The baseline `ppo`."""

    path: str = ""
    """ppo.safetensors of egovcp-train-ppo."""


@dataclass(frozen=True)
class EvalConfig:
    """Evaluate planner and reference controllers on held-out scenarios; print and save metrics."""

    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The policy; only for the controller `planner`."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the policy's planner."""
    task: str = DEFAULT_TASK
    """A name from `egovcp-task list`, package.module:Class, several as ball,wall, or all; sequence
    plays several in one episode (--env.sequence.parts)."""
    episodes: int = bounded(80, least=1, most=10**6)
    """Scenarios per task."""
    seed: int = bounded(0, least=0, below=SEEDS)
    """Seed of the held-out scenarios and of the planner's sampling."""
    controllers: str = ",".join(DEFAULT_CONTROLLERS)
    """Separated by commas: planner, hold (neutral pose), constant (best fixed action), random (the
    paper's walk), oracle (scripted, uses the simulator's state), ppo (model-free PPO)."""
    constant: ConstantOptions = field(default_factory=ConstantOptions)
    """The reference `constant`."""
    ppo: PpoOptions = field(default_factory=PpoOptions)
    """The baseline `ppo`."""
    output_dir: str = ""
    """New folder for the results."""
    videos: int = bounded(0, least=0, most=10**6)
    """Render the first N scenarios of each task, with each controller, as GIF, and as MP4 if PyAV
    is installed (egovcp[video]): rollout-<task>-<controller>-<i>.gif; needs matplotlib."""
    num_envs: int = bounded(8, least=1, most=65_536)
    """Scenarios that each process simulates in parallel."""
    num_workers: int = bounded(0, least=0, per_core=MAX_PER_CORE)
    """Processes; 0: one per processor core."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks to play."""
        return select_tasks(self.task)

    @property
    def controller_names(self) -> tuple[str, ...]:
        """The controllers to play, each once."""
        names = self.controllers.strip("[]").replace(" ", "").split(",")
        return tuple(dict.fromkeys(names))

    def check(self) -> None:
        """Raise `UsageError` for invalid or contradictory options."""
        for task in self.tasks:
            if "oracle" in self.controller_names and not find_task(task).has_oracle():
                raise UsageError(f"task {task} has no oracle; leave it out of --controllers")
        for name in self.controller_names:
            if name not in (known := (*DEFAULT_CONTROLLERS, PPO)):
                raise UsageError(f"unknown value --controllers={name}{suggest(name, known)}")
        workers = self.num_workers or available_cores()
        robots = min(self.num_envs * workers, self.episodes * len(self.tasks))
        require_memory_for_robots("--num_envs", self.num_envs, robots)
        if PLANNER in self.controller_names:
            self.policy.require("leave planner out of --controllers")
        if PPO in self.controller_names and not self.ppo.path:
            raise UsageError(
                "--ppo.path is missing; name the file of egovcp-train-ppo, or leave ppo out of "
                "--controllers"
            )
        if self.videos:
            require_packages("egovcp-deploy", "--videos", "matplotlib")
        check_output_dir(self.output_dir)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(EvalConfig, evaluate, argv, prog=PROG, epilog=_EPILOG)


def evaluate(config: EvalConfig) -> None:
    """Check everything, play, print the table and write the files, also after an error or a signal:
    the finished episodes are saved; the result files are marked incomplete if some are missing.
    Raises the errors of options, files and policy, `EnvironmentFailure` if a worker was killed, and
    `KeyboardInterrupt` after SIGINT or SIGTERM."""
    config.check()
    config = replace(config, env=resolve_config(config.env, config.tasks))
    controller_id = controller_id_of(config.env, config.tasks)
    env = encoded(config.env) | {"controller": None}  # its identity is compared instead of its path
    setting = {"low_level_controller": controller_id, "env": env}
    path = config.constant.path
    constants = load_constants(user_path(path), setting) if path else {}
    artifact, ppo, backend = None, None, ""
    if PLANNER in config.controller_names:
        artifact = load_policy(config.policy, config.planner)
        artifact.require_controller(controller_id)
        policy = artifact.make_policy(1, config.seed)
        policy.prepare()  # compile once, before workers need it
        backend = backend_of(policy)
    if PPO in config.controller_names:
        ppo = ReactiveNetwork.load(user_path(config.ppo.path))
        ppo.require_controller(controller_id)
    folder = make_output_dir(config.output_dir)
    scores: Scores = {task: {name: [] for name in config.controller_names} for task in config.tasks}
    try:
        with (
            stop_on_signal() as received,
            closing(EpisodePool(config, artifact, lambda: bool(received))) as pool,
        ):
            if CONSTANT in config.controller_names:
                constants = _find_constants(config, pool, constants)
                found = {task: asdict(best) for task, best in constants.items()}
                write_json(folder / "constant.json", {**setting, "constants": found})
            _run_episodes(config, pool, constants, scores, folder)
            if received:
                raise KeyboardInterrupt
    finally:
        incomplete = _incomplete(config, scores)
        if played := _sorted_scores(scores):
            record = {
                "backend": backend,
                "complete": not incomplete,
                "config": encoded(config, "policy.path", "constant.path", "ppo.path", "output_dir"),
                "artifact": artifact.manifest if artifact else None,
                "ppo": dict(ppo.provenance) if ppo else None,
                "low_level_controller": controller_id,
                "versions": evaluation_versions(),
                "constants": {task: asdict(best) for task, best in constants.items()},
                "episodes": {
                    task: {
                        name: [_score_json(score) for score in episode_scores]
                        for name, episode_scores in by_controller.items()
                    }
                    for task, by_controller in played.items()
                },
            }
            figures = summary(played, config.episodes)
            write_json(folder / "eval_run.json", record)
            write_json(folder / "eval.json", figures)
            echo(table(figures))
            if backend:
                echo(f"plans computed by {backend}")
            every = chain(*(chain(*by_controller.values()) for by_controller in played.values()))
            if skipped := sum(score.skipped for score in every):
                echo(f"{skipped} observations were not finite and were skipped; see eval_run.json")
            if incomplete:
                echo(f"INCOMPLETE: {', '.join(incomplete)} episodes played")
            echo(f"metrics: {folder / 'eval.json'}")


def _sorted_scores(scores: Scores) -> Scores:
    """The scores in the order of the scenarios, without tasks and controllers without episodes."""
    found = {
        task: {
            name: sorted(episode_scores, key=lambda score: score.episode)
            for name, episode_scores in by_controller.items()
            if episode_scores
        }
        for task, by_controller in scores.items()
    }
    return {task: by_controller for task, by_controller in found.items() if by_controller}


def _incomplete(config: EvalConfig, scores: Scores) -> list[str]:
    """``[ball hold 0 of 80, ...]``: the controllers whose episodes are not complete."""
    counts = {f"{task} {name}": len(scores[task][name]) for task in scores for name in scores[task]}
    total = config.episodes
    return [f"{name} {count} of {total}" for name, count in counts.items() if count < total]


def _find_constants(
    config: EvalConfig, pool: EpisodePool, known: dict[str, BestConstant]
) -> dict[str, BestConstant]:
    """Task -> best constant action, searched unless ``known``."""
    found = {}
    for task in config.tasks:
        if task in known:
            found[task] = known[task]
            continue
        with tqdm(unit="ep", desc=f"{task}: best constant action") as bar:

            def play(
                actions: Sequence[Action], scenarios: Sequence[Scenario]
            ) -> list[list[EpisodeScore]]:
                groups = [
                    EpisodeGroup(CONSTANT, part, action)
                    for action in actions
                    for part in batched(scenarios, config.num_envs)
                ]
                parts: dict[int, list[EpisodeScore]] = {}
                for i, part in pool.play(groups):
                    parts[i] = part
                    bar.update(len(part))
                scores = [score for i in sorted(parts) for score in parts[i]]
                if len(scores) < len(actions) * len(scenarios):
                    raise KeyboardInterrupt
                return [list(each) for each in batched(scores, len(scenarios))]

            found[task] = search_constant(task, config.seed, play)
    return found


def _run_episodes(
    config: EvalConfig,
    pool: EpisodePool,
    constants: dict[str, BestConstant],
    scores: Scores,
    folder: Path,
) -> None:
    """Play every controller on every task, and add the scores to ``scores``; videos go to
    ``folder``. The planner's groups are the first, since they take longest."""
    groups = []
    for name in sorted(config.controller_names, key=lambda name: name != PLANNER):
        for task in config.tasks:
            scenarios = [held_out(task, config.seed, i) for i in range(config.episodes)]
            for part in batched(scenarios, config.num_envs):
                action = constants[task].action if name == CONSTANT else ()
                stems = [folder / f"rollout-{task}-{name}-{s.episode}" for s in part]
                videos = tuple(stems[: max(0, config.videos - part[0].episode)])
                groups.append(EpisodeGroup(name, part, action, videos))
    total = config.episodes * len(config.controller_names) * len(config.tasks)
    with tqdm(total=total, unit="ep", desc="evaluate") as bar:
        for i, played in pool.play(groups):
            scores[groups[i].scenarios[0].task][groups[i].controller] += played
            successes = {
                name: [score.success for row in scores.values() for score in row[name]]
                for name in config.controller_names
            }
            rates = [f"{name} {np.mean(each):.0%}" for name, each in successes.items() if each]
            bar.set_postfix_str(", ".join(rates), refresh=False)
            bar.update(len(played))


def _score_json(score: EpisodeScore) -> dict[str, Any]:
    empty = {name for name in ("parts", "terms") if not getattr(score, name)}
    return {k: v for k, v in asdict(score).items() if k not in empty | {"plan_ms"}}
