"""`egovcp-compare`: two evaluations on the same scenarios, episode by episode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from egovcp.cli import run_command
from egovcp.errors import DataError, UsageError, suggest
from egovcp.files import read_json
from egovcp.terminal import echo
from egovcp_deploy.report import aligned
from egovcp_deploy.scores import (
    EpisodeScore,
    paired,
    reward_gain,
    reward_per_step,
    success_gain,
    success_rate,
)

PROG: Final = "egovcp-compare"
_FILE: Final = "eval_run.json"
_LIMIT_BYTES: Final = 256 << 20
#: Options that say where something is or who computes it.
_PLACES: Final = ("output_dir", "num_envs", "num_workers", "episodes", "constant.path")
_EPILOG: Final = (
    "Both must have been played on the same scenarios: same --task and --seed of egovcp-eval. "
    "Differences are RUN - OTHER, and their 95 % intervals come from drawing scenarios again, each "
    "with both of its episodes, so that how hard it is does not count. An interval without 0 is a "
    "difference that chance hardly explains. Options in which the runs differ are listed first: "
    "with other `egovcp-eval --env.*` the scenes are not the same. With one run, compare two of "
    "its controllers: --other_controller=hold."
)
_HEAD: Final = (
    *("task", "episodes", "success", "other", "points", "95 %"),
    *("reward/step", "other", "difference", "95 %"),
)


@dataclass(frozen=True)
class CompareConfig:
    """Say by how much one evaluation is better than another, and whether that may be chance."""

    run: str = ""
    """Folder that egovcp-eval wrote."""
    other: str = ""
    """Another one, on the same scenarios; empty: the same."""
    controller: str = "planner"
    """Whose episodes."""
    other_controller: str = ""
    """Whose of the other; empty: the same."""

    def check(self) -> None:
        """Raise `UsageError` for values that make no sense."""
        if not self.run:
            raise UsageError("--run is missing; name a folder that egovcp-eval wrote")
        if not self.other and self.other_controller in ("", self.controller):
            raise UsageError("name a second folder with --other, or --other_controller")


@dataclass(frozen=True)
class Evaluation:
    """What `egovcp-eval` keeps of one run."""

    folder: str
    config: Mapping[str, Any]
    """Options of egovcp-eval."""
    episodes: Mapping[str, Mapping[str, Sequence[EpisodeScore]]]
    """Task -> controller -> episodes."""
    complete: bool = True
    """Whether all episodes that were asked for were played."""

    def played_by(self, task: str, controller: str) -> dict[int, EpisodeScore]:
        """Number of the scenario -> episode.

        Raises:
            UsageError: the controller was not played.
        """
        row = self.episodes[task]
        if controller not in row:
            raise UsageError(f"{self.folder} has no {controller}{suggest(controller, row)}")
        return {score.episode: score for score in row[controller]}


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(CompareConfig, compare, argv, prog=PROG, epilog=_EPILOG)


def compare(config: CompareConfig) -> None:
    """Print a line for each task that both runs have played.

    Raises:
        UsageError: an option makes no sense, or the runs have no scenario in common.
        DataError: a folder has no readable eval_run.json.
    """
    config.check()
    run = load_evaluation(Path(config.run))
    other = load_evaluation(Path(config.other or config.run))
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
    theirs = config.other_controller or config.controller
    lines = [
        _line(task, run.played_by(task, config.controller), other.played_by(task, theirs))
        for task in tasks
    ]
    echo(f"{config.controller} of {run.folder} beside {theirs} of {other.folder}")
    for each in dict.fromkeys(e.folder for e in (run, other) if not e.complete):
        echo(f"{each} is incomplete: egovcp-eval was interrupted")
    for name, ours, others in _differences(run.config, other.config):
        if name not in _PLACES:
            echo(f"--{name}={ours}, of the other {others}")
    echo(aligned([_HEAD, *lines], words=1))


def load_evaluation(folder: Path) -> Evaluation:
    """What egovcp-eval has written to ``folder``.

    Raises:
        DataError: no such file, or not one of ours.
    """
    path = folder / _FILE
    try:
        content = read_json(path, _LIMIT_BYTES)
        episodes = {
            task: {name: [_score(entry) for entry in played] for name, played in row.items()}
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


def _score(entry: Mapping[str, Any]) -> EpisodeScore:
    known = {field.name for field in fields(EpisodeScore)}
    return EpisodeScore(**{name: value for name, value in entry.items() if name in known})


def _line(
    task: str, ours: Mapping[int, EpisodeScore], theirs: Mapping[int, EpisodeScore]
) -> tuple[str, ...]:
    a, b = paired(tuple(ours.values()), tuple(theirs.values()))
    if not a:
        raise UsageError(f"no scenario of {task} was played by both")
    low, high = success_gain(a, b)
    least, most = reward_gain(a, b)
    return (
        task,
        str(len(a)),
        f"{success_rate(a):.1%}",
        f"{success_rate(b):.1%}",
        f"{100 * (success_rate(a) - success_rate(b)):+.1f}",
        f"{100 * low:+.1f} to {100 * high:+.1f}",
        f"{reward_per_step(a):+.5f}",
        f"{reward_per_step(b):+.5f}",
        f"{reward_per_step(a) - reward_per_step(b):+.5f}",
        f"{least:+.5f} to {most:+.5f}",
    )


def _differences(
    ours: Mapping[str, Any], others: Mapping[str, Any], above: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """(dotted name, value, the other's value) wherever two configurations differ."""
    for key in [*ours, *(key for key in others if key not in ours)]:
        a, b = ours.get(key), others.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from _differences(a, b, f"{above}{key}.")
        elif a != b:
            yield f"{above}{key}", a, b


if __name__ == "__main__":
    raise SystemExit(main())
