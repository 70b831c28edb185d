"""`egovcp-dataset coverage`: statistics of a dataset, and whether it is suitable for training."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from egovcp.checks.lerobot_episode import Statistics, describe
from egovcp.data import DatasetConfig, DatasetReader, ReturnConfig
from egovcp.data.destination import require_outside
from egovcp.data.features import nonfinite_problem, values_of
from egovcp.data.lerobot import LeRobotReader, is_own
from egovcp.data.source import locate
from egovcp.data.stats import aggregate_named
from egovcp.errors import DataError, UsageError
from egovcp.files import user_path
from egovcp.outputs import output_file, require_writable, write_report
from egovcp.terminal import echo, echo_lines
from egovcp_collect.dataset.figures import draw_figures, require_matplotlib
from egovcp_collect.dataset.statistics import (
    DatasetStatistics,
    Distribution,
    TaskStatistics,
    compute_statistics,
)

_CONSTANT: Final = 1e-8  # largest std of a constant value, relative to max(1, |mean|)
_SHORT_S: Final = 1.0


@dataclass(frozen=True)
class CoverageLimits:
    """Limits beyond which a dataset may be unsuitable for training."""

    event_episodes: int = 100  # least episodes of a task with a success or failure event
    event_episodes_per_1000: float = 0.5  # least such episodes per 1000 ticks
    # least share of frames with a success event within the return horizon (failure event, if the
    # task has no success events)
    event_frames: float = 0.01
    valid_frames: float = 0.2  # least share of frames with a return not cut short by the time limit
    return_std: float = 0.02  # least standard deviation of the return
    one_outcome: float = 0.98  # largest share of episodes with the same outcome
    uniformity: float = 0.7  # least uniformity of an action
    occupied: float = 0.5  # least share of occupied cells of the action box, of each hand
    valid_pixels: float = 0.05  # least share of measured pixels; an empty room is mostly far away
    empty_frames: float = 0.25  # largest share of frames without a measured pixel
    balance: float = 0.5  # least share of a task's frames, relative to equal shares


_LIMITS: Final = CoverageLimits()


@dataclass(frozen=True)
class CoverageConfig:
    """Report event rates, returns, actions, depth and scenes of a dataset, and assess them.

    Reads all columns except depth, and depth of up to 12 episodes per task. Failed checks do not
    change the exit code. Of a dataset of another robot than the G1, or that egovcp did not collect,
    it reports the range of every number, and those that are constant, and ignores --returns.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    output_dir: str = ""
    """Folder for the plots events.png, returns.png, actions.png, depth.png (of datasets of the G1
    only); empty: none."""
    json: str = output_file()
    """File for the report: {"tasks": {TASK: statistics}, "assessment": {"suitable", "summary",
    "checks": [{"passed", "task", "text"}]}}, or {"length_s", "features": {FEATURE: {VALUE:
    statistics}}, "warnings", "not_assessed"} of another robot or origin; empty: none."""
    returns: ReturnConfig = field(default_factory=ReturnConfig)
    """The Monte Carlo return in the report and the plots."""


@dataclass(frozen=True)
class CoverageCheck:
    """The result of one check of one task."""

    passed: bool
    task: str
    text: str


def run_coverage(config: CoverageConfig) -> None:
    """Print statistics and assessment; draw the plots.

    Raises:
        UsageError: plots of a dataset of another robot or origin, or invalid --returns.
        DataError: a file is damaged, or a value is not finite.
    """
    config.returns.check()
    folder = user_path(config.output_dir)
    if config.output_dir:
        require_matplotlib()
        require_writable(folder)
    source = locate(config.dataset)
    root = source.root
    require_outside(root, config.json)
    reader = DatasetReader.open_source(source) if is_own(root) else None
    if reader is None or not reader.robot.is_g1:
        if config.output_dir:
            raise UsageError(
                f"--output_dir: {root} is not a dataset of the G1 that egovcp collected, and plots "
                "are of those only; drop it"
            )
        write_report(config.json, _report_features(LeRobotReader.open(root)))
        return
    statistics = compute_statistics(reader, config.returns)
    checks = assess(statistics)
    assessment = {
        "suitable": all(check.passed for check in checks),
        "summary": summary(checks),
        "checks": [asdict(check) for check in checks],
    }
    tasks = {task.task: asdict(task) for task in statistics.tasks}
    write_report(config.json, {"tasks": tasks, "assessment": assessment})
    echo(f"{reader.root}: {len(reader)} episodes, {reader.num_frames} frames\n")
    for task in statistics.tasks:
        echo_lines([*_describe(task), ""])
    echo("assessment")
    for check in checks:
        echo(f"  {'ok  ' if check.passed else 'warn'}  {check.task}: {check.text}")
    echo(f"  {summary(checks)}")
    if config.output_dir:
        for path in draw_figures(statistics, config.returns, folder):
            echo(f"wrote {path}")


def coverage_texts(task: TaskStatistics) -> dict[str, str]:
    """Statistic -> text, for the report and the card."""
    r, d, length = task.returns, task.depth, task.length
    spread = r.distribution
    return {
        "episodes": f"{task.episodes}",
        "frames": f"{task.frames} ({task.frame_share:.0%})",
        "ticks per episode": f"{length.low:.0f} to {length.high:.0f}" if length else "none",
        "episodes that succeed": f"{task.success_share:.1%}",
        "episodes that end in a fall": f"{task.fall_share:.1%}",
        f"return (gamma {r.gamma:g}, {r.horizon} ticks), mean and std": (
            f"{spread.mean:.3f}, {spread.std:.3f}" if spread else "none"
        ),
        "return, 5 % to 95 %": f"{spread.q05:.3f} to {spread.q95:.3f}" if spread else "none",
        "frames with a success event within the return horizon": f"{r.success_event_share:.1%}",
        "frames with a failure event within the return horizon": f"{r.failure_event_share:.1%}",
        "occupied cells of the action box": ", ".join(
            f"{hand} {share:.0%}" for hand, share in task.action.occupied.items()
        ),
        "depth pixels measured, nearer than 1 m": f"{d.valid_share:.0%}, {d.near_share:.1%}",
    }


def _describe(task: TaskStatistics) -> Iterator[str]:
    yield f"{task.task}:"
    for name, text in coverage_texts(task).items():
        yield f"  {name:54}{text}"
    yield "  reward terms and contacts per 1000 ticks, share of episodes"
    for name, rate in task.term_rates.items():
        yield f"    {name:24}{rate.per_1000_ticks:8.2f}   {rate.episode_share:8.1%}"
    yield "  actions                   uniformity (0 to 1), range of targets in m"
    for name, (low, high) in task.action.workspace_m.items():
        yield f"    {name:24}{task.action.uniformity[name]:8.2f}     {low:6.2f} to {high:5.2f}"
    yield "  scenes                    drawn parameters"
    for name, drawn in task.scene.items():
        yield f"    {name:26}{drawn.low:9.3g} to {drawn.high:.3g}, mean {drawn.mean:.3g}"


def assess(statistics: DatasetStatistics, limits: CoverageLimits = _LIMITS) -> list[CoverageCheck]:
    """The checks of all tasks."""
    least_share = limits.balance / len(statistics.tasks)
    return [
        CoverageCheck(passed, task.task, text if passed else f"{text}; expected {expected}")
        for task in statistics.tasks
        for passed, text, expected in _checks(task, limits, least_share)
    ]


def summary(checks: Iterable[CoverageCheck]) -> str:
    """The assessment in one sentence."""
    failed = [check for check in checks if not check.passed]
    if not failed:
        return "suitable for training: all checks passed"
    tasks = ", ".join(dict.fromkeys(check.task for check in failed))
    return f"may be unsuitable for training: {len(failed)} checks failed ({tasks})"


def _checks(
    task: TaskStatistics, limits: CoverageLimits, least_share: float
) -> Iterator[tuple[bool, str, str]]:
    """(passed, finding, expected finding and advice) of each check of a task."""
    events = task.event_episodes
    rate = 1000.0 * events / task.frames
    yield (
        events >= limits.event_episodes and rate >= limits.event_episodes_per_1000,
        f"{events} episodes with an event, {rate:.2f} per 1000 ticks",
        f"at least {limits.event_episodes}, and {limits.event_episodes_per_1000} per 1000 ticks: "
        "collect more, or shorten the episodes",
    )
    kind = "success" if task.has_success_events else "failure"  # if the reward has costs only
    successes, failures = task.success_event_episodes, task.failure_event_episodes
    yield (
        failures > 0 and (successes > 0 or not task.has_success_events),
        f"{successes} episodes with a success event, {failures} with a failure event",
        "at least one of each" if task.has_success_events else "at least one with a failure event",
    )
    success = task.success_share
    yield (
        max(success, 1.0 - success) <= limits.one_outcome,
        f"{success:.0%} of the episodes succeed, {task.fall_share:.0%} fall",
        f"both outcomes: make the scenes {'harder' if success > 0.5 else 'easier'}",
    )
    r = task.returns
    yield (
        r.distribution is not None and r.valid_share >= limits.valid_frames,
        f"{r.valid_share:.0%} of the frames have a return over {r.horizon} ticks",
        f"at least {limits.valid_frames:.0%}: lengthen the episodes or shorten --returns.steps",
    )
    if r.distribution is not None:
        yield (
            r.distribution.std >= limits.return_std,
            f"return {r.distribution.mean:.3f} +- {r.distribution.std:.3f}",
            f"a standard deviation of at least {limits.return_std}",
        )
        yield (
            (r.success_event_share if task.has_success_events else r.failure_event_share)
            >= limits.event_frames,
            f"{r.success_event_share:.1%} of the frames have a success event ahead, "
            f"{r.failure_event_share:.1%} a failure event",
            f"at least {limits.event_frames:.0%} with a {kind} event",
        )
    name, uniformity = min(task.action.uniformity.items(), key=lambda item: item[1])
    yield (
        uniformity >= limits.uniformity,
        f"lowest uniformity of an action: {uniformity:.2f} ({name})",
        f"at least {limits.uniformity}",
    )
    hand, occupied = min(task.action.occupied.items(), key=lambda item: item[1])
    yield (
        occupied >= limits.occupied,
        f"fewest occupied cells of the action box: {occupied:.0%} ({hand} hand)",
        f"at least {limits.occupied:.0%}",
    )
    valid, empty = task.depth.valid_share, task.depth.empty_share
    yield (
        valid >= limits.valid_pixels and empty <= limits.empty_frames,
        f"{valid:.0%} of the depth pixels were measured, {empty:.0%} of the frames are empty",
        f"at least {limits.valid_pixels:.0%} and at most {limits.empty_frames:.0%}: check the "
        "camera",
    )
    yield (
        task.frame_share >= least_share,
        f"{task.frame_share:.0%} of the frames",
        f"at least {least_share:.0%}: collect more of this task",
    )


# --- datasets of other features -------------------------------------------------------
def _report_features(reader: LeRobotReader) -> dict[str, Any]:
    """Print the coverage and its assessment; returns them, JSON-compatible.

    Raises:
        DataError: a file is damaged, or a value is not finite.
    """
    lengths = np.array([row.length for row in reader.rows]) / reader.fps
    features = {
        key: {
            reader.features[key].label(i): {name: float(value[i]) for name, value in found.items()}
            for i in range(reader.features[key].size)
        }
        for key, found in _feature_statistics(reader).items()
    }
    echo(f"{reader.root}: {len(lengths)} episodes, {reader.num_frames} frames\n")
    spread = Distribution.of(lengths)
    if spread is not None:
        echo(
            f"length of an episode {spread.low:.2f} to {spread.high:.2f} s, mean {spread.mean:.2f}"
        )
    for key, values in features.items():
        echo_lines(["", f"{key:40}{'min':>11}{'mean':>11}{'max':>11}{'std':>11}"])
        for name, value in values.items():
            numbers = (value[part] for part in ("min", "mean", "max", "std"))
            echo(f"  {name:38}" + "".join(f"{number:11.4g}" for number in numbers))
    warnings = [
        f"{name} is always {value['mean']:g}: it carries no information, and normalisation "
        "magnifies any later change"
        for values in features.values()
        for name, value in values.items()
        if value["std"] <= _CONSTANT * max(1.0, abs(value["mean"]))
    ]
    if short := int((lengths < _SHORT_S).sum()):
        warnings.append(f"{short} episodes are shorter than {_SHORT_S:g} s")
    missing = [key for key in ("action", "observation.state") if key not in reader.features]
    cameras = any(feature.is_camera for feature in reader.features.values())
    notes = ["cameras: their pixels are not read"] if cameras else []
    notes += [f"{key}: the dataset has none" for key in missing]
    if "next.reward" not in reader.features:
        notes.append("events, returns and success: there is no next.reward")
    echo("\nassessment")
    lines = [f"warning: {text}" for text in warnings]
    lines = lines or ["no value is constant, and no episode is short"]
    echo_lines(f"  {line}" for line in [*lines, *(f"not assessed: {note}" for note in notes)])
    length = asdict(spread) if spread is not None else None
    return {"length_s": length, "features": features, "warnings": warnings, "not_assessed": notes}


def _feature_statistics(reader: LeRobotReader) -> dict[str, Statistics]:
    """Statistics of each numeric feature over all frames, (n,) each."""
    features = reader.numeric
    parts: dict[str, list[tuple[int, Statistics]]] = {f.key: [] for f in features}
    for path in reader.data_files:
        for found in reader.episodes(path, [*parts]):
            if isinstance(found, DataError):
                raise found
            number, table = found
            for feature in features:
                if feature.key not in table.column_names:
                    raise DataError.at(path, f"column {feature.key} is missing", number)
                try:
                    values = values_of(table[feature.key], feature)
                except DataError as error:
                    problem = error.problem or str(error)
                    raise DataError.at(path, problem, number, error.frame) from error
                nonfinite = nonfinite_problem(values, feature)
                if nonfinite is not None:
                    frame, problem = nonfinite
                    raise DataError.at(path, problem, number, frame)
                parts[feature.key].append((len(table), describe(values)))
    return {key: aggregate_named(found) for key, found in parts.items() if found}
