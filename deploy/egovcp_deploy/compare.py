"""`egovcp-compare`: two evaluations on the same scenarios, episode by episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from egovcp.cli import run_command
from egovcp.errors import DataError, UsageError, suggest
from egovcp.files import read_json, user_path
from egovcp.terminal import echo
from egovcp.values import differences
from egovcp_deploy.scores import EpisodeScore, aligned, eval_scores, paired

PROG: Final = "egovcp-compare"
_LIMIT_BYTES: Final = 256 << 20
#: Options that do not change the results.
_IRRELEVANT: Final = ("output_dir", "num_envs", "num_workers", "episodes", "videos")
_EPILOG: Final = (
    "Both runs must have the same scenarios: the same --task and --seed of egovcp-eval. "
    "Differences are RUN - OTHER. Their 95 % intervals are from a bootstrap over scenarios, each "
    "with both of its episodes, so that the difficulty of a scenario cancels. Options in which the "
    "runs differ are listed first: with different `egovcp-eval --env.*` the scenes are not the "
    "same. With one run, compare two of its controllers: --other_controller=hold."
)
_HEAD: Final = (
    *("task", "episodes", "success", "other", "difference, points (95 %)"),
    *("reward/step", "other", "difference (95 %)"),
)


@dataclass(frozen=True)
class CompareConfig:
    """Compare two evaluations on the same scenarios, with confidence intervals."""

    run: str = ""
    """Folder that egovcp-eval wrote."""
    other: str = ""
    """Another folder, with the same scenarios; empty: the same folder."""
    controller: str = "planner"
    """Controller in RUN."""
    other_controller: str = ""
    """Controller in OTHER; empty: the same."""

    def check(self) -> None:
        """Raise `UsageError` for values that make no sense."""
        if not self.run:
            raise UsageError("--run is missing; name a folder that egovcp-eval wrote")
        if not self.other and self.other_controller in ("", self.controller):
            raise UsageError("name a second folder with --other, or --other_controller")


@dataclass(frozen=True)
class Evaluation:
    """Results of one run of `egovcp-eval`."""

    folder: str
    config: Mapping[str, Any]  # options of egovcp-eval
    episodes: Mapping[str, Mapping[str, Sequence[EpisodeScore]]]  # task -> controller -> episodes
    complete: bool = True  # whether all episodes were played

    def played_by(self, task: str, controller: str) -> Sequence[EpisodeScore]:
        """Episodes of ``controller``; raises `UsageError` if it did not play."""
        row = self.episodes[task]
        if controller not in row:
            raise UsageError(
                f"{self.folder} has no episodes of controller {controller}"
                f"{suggest(controller, row)}"
            )
        return row[controller]


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(CompareConfig, compare, argv, prog=PROG, epilog=_EPILOG)


def compare(config: CompareConfig) -> None:
    """Print one line for each task that both runs have played; raises `UsageError` if they cannot
    be compared, `DataError` if an eval_run.json cannot be read."""
    config.check()
    run = load_evaluation(user_path(config.run))
    other = load_evaluation(user_path(config.other or config.run))
    seeds = [each.config["seed"] for each in (run, other)]
    if seeds[0] != seeds[1]:
        raise UsageError(
            f"{run.folder} played the scenarios of --seed={seeds[0]}, {other.folder} those of "
            f"--seed={seeds[1]}; nothing can be paired"
        )
    tasks = [task for task in run.episodes if task in other.episodes]
    if not tasks:
        found = f"{', '.join(run.episodes)} and {', '.join(other.episodes)}"
        raise UsageError(f"{run.folder} and {other.folder} have no task in common: {found}")
    other_controller = config.other_controller or config.controller
    lines = []
    for task in tasks:
        a, b = paired(
            run.played_by(task, config.controller), other.played_by(task, other_controller)
        )
        if not a:
            raise UsageError(f"no scenario of {task} was played by both")
        ours, theirs = eval_scores(a), eval_scores(b)
        success, reward = ours.gain(theirs).columns()
        lines.append(
            (
                task,
                str(len(a)),
                f"{ours.success_rate:.1%}",
                f"{theirs.success_rate:.1%}",
                success,
                f"{ours.reward_per_step:+.5f}",
                f"{theirs.reward_per_step:+.5f}",
                reward,
            )
        )
    echo(f"{config.controller} of {run.folder} compared with {other_controller} of {other.folder}")
    for each in dict.fromkeys(e.folder for e in (run, other) if not e.complete):
        echo(f"{each} is incomplete: egovcp-eval was interrupted")
    for name, (run_value, other_value) in differences(run.config, other.config):
        if name not in _IRRELEVANT:
            echo(f"--{name}: {run_value} (RUN), {other_value} (OTHER)")
    echo(aligned([_HEAD, *lines], text_columns=1))


def load_evaluation(folder: Path) -> Evaluation:
    """Read the results of egovcp-eval in ``folder``; raises `DataError` if eval_run.json is missing
    or of another format."""
    path = folder / "eval_run.json"
    known = {field.name for field in fields(EpisodeScore)}
    try:
        content = read_json(path, _LIMIT_BYTES)
        episodes = {
            task: {
                name: [
                    EpisodeScore(**{key: entry[key] for key in entry if key in known})
                    for entry in played
                ]
                for name, played in row.items()
            }
            for task, row in content["episodes"].items()
        }
        config = dict(content["config"])
        complete = bool(content.get("complete", True))
        return Evaluation(str(folder), config | {"seed": int(config["seed"])}, episodes, complete)
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror}; expected a folder that egovcp-eval wrote"
        ) from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(f"{path} is not what egovcp-eval writes: {error!r}") from error
