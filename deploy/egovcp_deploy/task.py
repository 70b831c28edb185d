"""`egovcp-task`: list tasks, check one, show it, and write a package for a new one."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Final, Literal

from egovcp.bounds import bounded
from egovcp.checks import ConformanceError, check_task
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.files import write_text
from egovcp.outputs import output_file, write_report
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp.sim.tasks.registry import find_task, name_problem, task_entries
from egovcp.subcommands import CommandGroup, Subcommand
from egovcp.terminal import echo
from egovcp_deploy.options import SEEDS, make_output_dir
from egovcp_deploy.scores import aligned

COMMANDS: Final = CommandGroup(
    "egovcp-task",
    "List contact tasks, check one, show it, and write a package for a new one.",
    {
        "list": Subcommand(f"{__name__}:run_list", "what there is, and which package provides it"),
        "check": Subcommand(
            f"{__name__}:run_check",
            "play it; verify seeds, rewards and ends of episodes",
            ("task",),
        ),
        "play": Subcommand(
            f"{__name__}:run_play",
            "record episodes of a scripted controller: Rerun, GIF",
            ("task",),
        ),
        "new": Subcommand(
            f"{__name__}:run_new", "write a package with a task that works, and its test", ("name",)
        ),
    },
    "TASK is a name from `egovcp-task list`, or package.module:Class.",
)
main = COMMANDS.main

_CONTROLLERS: Final = ("hold", "random", "oracle")


@dataclass(frozen=True)
class ListConfig:
    """List the tasks of all installed packages, and those that cannot be used."""


def run_list(config: ListConfig) -> None:
    """Print one line per task."""
    require_packages("egovcp-deploy", "egovcp-task", *SIMULATOR_MODULES)
    rows = [
        (entry.name, entry.origin, entry.task.description if entry.task else f"! {entry.problem}")
        for entry in task_entries()
    ]
    echo(aligned(rows, text_columns=3))


@dataclass(frozen=True)
class CheckTaskConfig:
    """Play a task under hold, random actions and its oracle, and verify that it conforms: seeds
    reproduce episodes bit for bit, rewards are finite, bounded and the sum of their terms, and
    success does not end an episode."""

    task: str
    """Name of the task, or package.module:Class."""
    episodes: int = bounded(2, least=1, most=1000)
    """Scenarios of each controller."""
    seed: int = bounded(0, least=0, most=10**9)
    """Which scenarios."""
    json: str = output_file()
    """File for the metrics; empty: none."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation."""


def run_check(config: CheckTaskConfig) -> None:
    """Print success, rewards and cost; raises `EnvironmentFailure` if the task does not conform."""
    require_packages("egovcp-deploy", "egovcp-task", *SIMULATOR_MODULES)
    try:
        report = check_task(config.task, config.episodes, config.seed, config.env)
    except ConformanceError as error:
        raise EnvironmentFailure(f"{error}; repair the class of the task") from error
    write_report(config.json, asdict(report))
    terms = list(next(iter(report.reward.values())))
    rows = [("", "success", *terms)]
    for name in (name for name in _CONTROLLERS if name in report.reward):
        sums = (f"{report.reward[name][term]:+.3f}" for term in terms)
        rows.append((name, f"{report.success_rate[name]:.0%}", *sums))
    echo(aligned(rows, text_columns=1))
    oracle = "" if "oracle" in report.reward else "; it has no oracle"
    echo(f"{report.task} conforms: {report.ms_per_step:.1f} ms per robot and step{oracle}")


@dataclass(frozen=True)
class PlayTaskConfig:
    """Record episodes of a task in simulation, driven by a scripted controller."""

    task: str
    """Name of the task, or package.module:Class."""
    controller: Literal["hold", "random", "oracle"] = "oracle"
    """hold (neutral pose), random (the paper's walk), or oracle (the task's scripted solution)."""
    episodes: int = bounded(1, least=1, most=1_000_000)
    """Number of episodes."""
    seed: int = bounded(0, least=0, below=SEEDS)
    """Which held-out scenarios, as in egovcp-eval."""
    output_dir: str = ""
    """New folder for rollout-<i>.rrd, .gif and .mcap."""
    live: str = ""
    """Also show the episodes as they are played: web (a page for browsers), or spawn (the Rerun
    viewer)."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation."""


def run_play(config: PlayTaskConfig) -> None:
    """Play, record, and name the files. Raises as `egovcp_deploy.deploy.deploy`."""
    require_packages("egovcp-deploy", "egovcp-task", *SIMULATOR_MODULES, "matplotlib")
    from egovcp_deploy.config import DeployConfig  # torch and rerun take seconds
    from egovcp_deploy.deploy import check_options
    from egovcp_deploy.recording import LogOptions, print_viewer_command
    from egovcp_deploy.rollouts import play_rollouts

    task = find_task(config.task)
    if config.controller == "oracle" and not task.has_oracle():
        raise UsageError(f"task {task.name} has no oracle; choose --controller=hold or random")
    rollouts = DeployConfig(
        controller=config.controller,
        task=task.name,
        episodes=config.episodes,
        seed=config.seed,
        output_dir=config.output_dir,
        log=LogOptions(live=config.live, videos=config.episodes),
        env=config.env,
    )
    check_options(rollouts)
    folder = play_rollouts(rollouts, None)
    echo(f"video: {folder / 'rollout-0.gif'}")
    print_viewer_command(folder / "rollout-0.rrd")


@dataclass(frozen=True)
class NewTaskConfig:
    """Write an installable package with a working task, `touch a panel with a hand`, its oracle and
    its test, as a start for a task of your own."""

    name: str
    """Name of the task: lower-case letters, digits and _."""
    output_dir: str = ""
    """New folder for the package; empty: ./egovcp-task-NAME."""


def run_new(config: NewTaskConfig) -> None:
    """Write the files and print the next commands."""
    name = config.name
    if problem := name_problem(name):
        raise UsageError(problem)
    for entry in task_entries():
        if entry.name == name:
            raise UsageError(f"{entry.origin} has a task {name!r}; choose another name")
    folder = make_output_dir(config.output_dir or f"egovcp-task-{name}")
    words = {"@name@": name, "@class@": name.title().replace("_", "")}
    for template in sorted(files(__package__).joinpath("skeleton").iterdir(), key=lambda p: p.name):
        text, path = template.read_text(encoding="utf-8"), template.name.removesuffix(".in")
        for word, value in words.items():
            text, path = text.replace(word, value), path.replace(word, value)
        write_text(Path(folder) / path, text)
    quoted = shlex.quote(str(folder))
    echo(
        f"wrote {folder}; next:\n  pip install -e {quoted}\n  egovcp-task check {name}\n"
        f"  egovcp-task play {name} --output_dir=play-{name}\n  pytest {quoted}"
    )
