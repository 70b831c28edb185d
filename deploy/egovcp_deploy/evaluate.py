"""`egovcp-eval`: the planner and its references on the same held-out scenarios."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from itertools import batched
from pathlib import Path
from typing import Any, Final

import draccus
from tqdm import tqdm

from egovcp.artifact import Artifact
from egovcp.bounds import MOST_PER_CORE, bounded, check_bounds
from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.files import write_json
from egovcp.hardware import available_cores
from egovcp.policy_options import PlannerOptions, PolicyOptions, load_policy
from egovcp.reactive import ReactiveNetwork
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import EnvConfig, evaluation_config, require_memory_for_robots
from egovcp.sim.env import resolve_config
from egovcp.sim.scenario import EPISODE_TASKS, Scenario
from egovcp.spec import TASKS
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_deploy.constant_search import Action, BestConstant, load_constants, search_constant
from egovcp_deploy.controllers import CONTROLLERS, PPO
from egovcp_deploy.episodes import Group, Setup, Stage
from egovcp_deploy.options import (
    absolute_path,
    check_choice,
    check_output_dir,
    make_output_dir,
    versions,
)
from egovcp_deploy.policy import backend_of
from egovcp_deploy.report import gains, summary, table
from egovcp_deploy.scenarios import held_out
from egovcp_deploy.scores import EpisodeScore

PROG: Final = "egovcp-eval"
_ALL: Final = "all"
_EPILOG: Final = (
    "All controllers play the same scenarios, which no collection ever plays (seeds are "
    "offset), each with an event: no empty scenes unless --env.*_episode.empty_probability "
    "says so. Success: ball blocked by a hand and not hit elsewhere; wall still up and touched "
    "by hands only; arch passed untouched; sequence: all of its parts, whose shares stand "
    "beneath. 'constant' is the best fixed action of a grid, "
    "chosen on scenarios of its own. plan_ms is the time per robot when num_envs robots are "
    "planned together; --num_envs=1 --num_workers=1 gives the latency of one. Writes eval.json "
    "(figures), eval_run.json (config and every episode) and constant.json. Ctrl-C writes what was "
    "played so far, marked as incomplete."
)

type Scores = dict[str, dict[str, list[EpisodeScore]]]


@dataclass(frozen=True)
class ConstantOptions:
    """The reference `constant`."""

    path: str = ""
    """constant.json of an earlier evaluation; spares the search. Empty: search."""


@dataclass(frozen=True)
class PpoOptions:
    """The baseline `ppo`."""

    path: str = ""
    """ppo.safetensors of egovcp-train-ppo."""


@dataclass(frozen=True)
class EvalConfig:
    """Play held-out scenarios with the planner and with references; print and save figures."""

    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The policy artifact; not needed without the controller `planner`."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the artifact's planner."""
    task: str = "ball"
    """ball, wall, arch, all (these three), or sequence: several in one episode, by default
    [arch, ball] (--env.sequence.parts)."""
    episodes: int = bounded(80, least=1, most=10**6)
    """Scenarios per task."""
    seed: int = bounded(0, least=0)
    """Which held-out scenarios."""
    controllers: str = ",".join(CONTROLLERS)
    """Who plays, separated by commas: planner, hold (neutral pose), constant (best fixed action),
    random (the paper's walk), oracle (scripted, sees the truth), ppo (learned without a model)."""
    constant: ConstantOptions = field(default_factory=ConstantOptions)
    """The reference `constant`."""
    ppo: PpoOptions = field(default_factory=PpoOptions)
    """The baseline `ppo`."""
    output_dir: str = ""
    """New folder for the results."""
    num_envs: int = bounded(8, least=1, most=65_536)
    """Robots that each process plays side by side."""
    num_workers: int = bounded(0, least=0, per_core=MOST_PER_CORE)
    """Processes; 0: one per processor core."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks to play."""
        return TASKS if self.task == _ALL else (self.task,)

    @property
    def players(self) -> tuple[str, ...]:
        """The controllers to play, each once."""
        names = self.controllers.strip("[]").replace(" ", "").split(",")
        return tuple(dict.fromkeys(names))

    def check(self) -> None:
        """Raise `UsageError` for values that make no sense."""
        check_choice("--task", self.task, (*EPISODE_TASKS, _ALL))
        for name in self.players:
            check_choice("--controllers", name, (*CONTROLLERS, PPO))
        check_bounds(self, "--")
        workers = self.num_workers or available_cores()
        robots = min(self.num_envs * workers, self.episodes * len(self.tasks))
        require_memory_for_robots("--num_envs", self.num_envs, robots)
        held_out(self.tasks[0], self.seed, 0)
        if "planner" in self.players:
            self.policy.require("leave planner out of --controllers")
        if PPO in self.players and not self.ppo.path:
            raise UsageError(
                "--ppo.path is missing; name the file of egovcp-train-ppo, or leave ppo out of "
                "--controllers"
            )
        check_output_dir(self.output_dir)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(EvalConfig, evaluate, argv, prog=PROG, epilog=_EPILOG)


def evaluate(config: EvalConfig) -> None:
    """Check everything, play, print the table and write the files.

    Whatever ends it early, the episodes that have ended are written, marked as incomplete.

    Raises:
        UsageError: an option makes no sense, or the folder holds results.
        DataError: ``--constant.path`` cannot be used.
        ArtifactError: the artifact, or the policy of --ppo.path, is missing, damaged, or of another
            low-level controller.
        EnvironmentFailure: the backend of the planner cannot be used here, or a worker was killed.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    config.check()
    config = replace(config, env=resolve_config(config.env))
    constants = load_constants(Path(config.constant.path)) if config.constant.path else {}
    artifact = _load_policy(config)
    ppo = _load_ppo(config)
    backend = _prepare_planner(artifact, config.seed)
    folder = make_output_dir(config.output_dir)
    setup = Setup(config.env, config.policy, config.planner, config.seed, config.ppo.path)
    scores: Scores = {task: {name: [] for name in config.players} for task in config.tasks}
    try:
        with (
            stop_on_signal() as received,
            closing(Stage(setup, config.num_workers, artifact, lambda: bool(received))) as stage,
        ):
            if "constant" in config.players:
                constants = _find_constants(config, stage, constants)
                _require_going_on(received)
                found = {task: asdict(best) for task, best in constants.items()}
                write_json(folder / "constant.json", found)
            _play(config, stage, constants, scores)
            _require_going_on(received)
    finally:
        if played := _with_episodes(scores):
            record = _record(config, artifact, ppo, constants, played)
            _report(folder, config, {"backend": backend, **record}, played)


def _require_going_on(received: Sequence[int]) -> None:
    """Raise KeyboardInterrupt if a signal has asked for the end."""
    if received:
        raise KeyboardInterrupt


def _with_episodes(scores: Scores) -> Scores:
    """Without controllers and tasks of which no episode has ended, the episodes in order."""
    rows = {
        task: {
            name: sorted(played, key=lambda score: score.episode)
            for name, played in row.items()
            if played
        }
        for task, row in scores.items()
    }
    return {task: row for task, row in rows.items() if row}


def _report(folder: Path, config: EvalConfig, record: Mapping[str, Any], scores: Scores) -> None:
    """Write the files and print the table, also of an evaluation that ended early."""
    figures = summary(scores, config.episodes)
    write_json(folder / "eval_run.json", record)
    write_json(folder / "eval.json", figures)
    echo(table(figures))
    if backend := record["backend"]:
        echo(f"plans computed by {backend}")
    if skipped := sum(s.skipped for row in scores.values() for each in row.values() for s in each):
        echo(f"{skipped} observations were not finite and were skipped; see eval_run.json")
    if not record["complete"]:
        echo(f"INCOMPLETE: {_counts(config, scores)} episodes played")
    echo(f"figures: {folder / 'eval.json'}")


def _counts(config: EvalConfig, scores: Scores) -> str:
    """``ball planner 12 of 80, ball hold 0 of 80``."""
    return ", ".join(
        f"{task} {name} {len(scores.get(task, {}).get(name, ()))} of {config.episodes}"
        for task in config.tasks
        for name in config.players
    )


def _is_complete(config: EvalConfig, scores: Scores) -> bool:
    count = sum(len(played) for row in scores.values() for played in row.values())
    return count == len(config.tasks) * len(config.players) * config.episodes


def _load_policy(config: EvalConfig) -> Artifact | None:
    if "planner" not in config.players:
        return None
    artifact = load_policy(config.policy, config.planner)
    artifact.require_controller(make_controller(config.env.controller).id)
    return artifact


def _prepare_planner(artifact: Artifact | None, seed: int) -> str:
    """What computes the plans; compiled here, once, before workers need it. Empty: no planner."""
    if artifact is None:
        return ""
    policy = artifact.make_policy(1, seed)
    policy.prepare()
    return backend_of(policy)


def _load_ppo(config: EvalConfig) -> ReactiveNetwork | None:
    if PPO not in config.players:
        return None
    network = ReactiveNetwork.load(Path(config.ppo.path))
    network.require_controller(make_controller(config.env.controller).id)
    return network


def _find_constants(
    config: EvalConfig, stage: Stage, known: dict[str, BestConstant]
) -> dict[str, BestConstant]:
    """Task -> best constant action, searched for where it is not known yet."""
    found = {}
    for task in config.tasks:
        with tqdm(unit="ep", desc=f"{task}: best constant action") as bar:

            def play(
                actions: Sequence[Action], scenarios: Sequence[Scenario]
            ) -> list[EpisodeScore]:
                groups = [
                    Group("constant", tuple(s for _, s in part), tuple(a for a, _ in part))
                    for part in batched(zip(actions, scenarios, strict=True), config.num_envs)
                ]
                scores = _in_order(stage, groups, bar)
                if len(scores) < len(scenarios):
                    raise KeyboardInterrupt
                return scores

            found[task] = known.get(task) or search_constant(task, config.seed, play)
    return found


def _in_order(stage: Stage, groups: Sequence[Group], bar: Any) -> list[EpisodeScore]:
    """Scores of all groups in the order of their scenarios."""
    parts: dict[int, list[EpisodeScore]] = {}
    for i, scores in stage.play(groups):
        parts[i] = scores
        bar.update(len(scores))
    return [score for i in sorted(parts) for score in parts[i]]


def _play(
    config: EvalConfig, stage: Stage, constants: dict[str, BestConstant], scores: Scores
) -> None:
    """Every controller on every task, into ``scores``; progress shows the success rates so far."""
    groups = list(_groups(config, constants))
    total = sum(len(group.scenarios) for group in groups)
    with tqdm(total=total, unit="ep", desc="evaluate") as bar:
        for i, part in stage.play(groups):
            group = groups[i]
            scores[group.scenarios[0].task][group.controller] += part
            bar.set_postfix_str(_so_far(scores), refresh=False)
            bar.update(len(part))


def _groups(config: EvalConfig, constants: dict[str, BestConstant]) -> Iterable[Group]:
    """The planner's first, since they take longest."""
    for name in sorted(config.players, key=lambda name: name != "planner"):
        for task in config.tasks:
            scenarios = [held_out(task, config.seed, i) for i in range(config.episodes)]
            for part in batched(scenarios, config.num_envs):
                group = Group(name, part)
                if name == "constant":
                    group = replace(group, actions=(constants[task].action,) * len(part))
                yield group


def _so_far(scores: Scores) -> str:
    """``planner 61%, hold 20%``: over all tasks."""
    parts = []
    for name in next(iter(scores.values())):
        played = [score for task in scores.values() for score in task[name]]
        if played:
            parts.append(f"{name} {sum(s.success for s in played) / len(played):.0%}")
    return ", ".join(parts)


def _record(
    config: EvalConfig,
    artifact: Artifact | None,
    ppo: ReactiveNetwork | None,
    constants: dict[str, BestConstant],
    scores: Scores,
) -> dict[str, Any]:
    """Content of ``eval_run.json``: what the figures came from."""
    return {
        "complete": _is_complete(config, scores),
        "config": draccus.encode(_with_absolute_paths(config)),
        "artifact": artifact.manifest if artifact else None,
        "ppo": dict(ppo.provenance) if ppo else None,
        "low_level_controller": make_controller(config.env.controller).id,
        "versions": versions(),
        "constants": {task: asdict(best) for task, best in constants.items()},
        "success_gain_of_planner": gains(scores),
        "episodes": {
            task: {name: [_brief(score) for score in played] for name, played in row.items()}
            for task, row in scores.items()
        },
    }


def _with_absolute_paths(config: EvalConfig) -> EvalConfig:
    return replace(
        config,
        policy=replace(config.policy, path=absolute_path(config.policy.path)),
        constant=replace(config.constant, path=absolute_path(config.constant.path)),
        ppo=replace(config.ppo, path=absolute_path(config.ppo.path)),
        output_dir=absolute_path(config.output_dir),
    )


def _brief(score: EpisodeScore) -> dict[str, Any]:
    left_out = {"plan_ms"} if score.parts else {"plan_ms", "parts"}
    return {name: value for name, value in asdict(score).items() if name not in left_out}


if __name__ == "__main__":
    raise SystemExit(main())
