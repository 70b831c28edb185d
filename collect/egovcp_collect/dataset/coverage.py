"""`egovcp-dataset coverage`: is this dataset worth training on?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from egovcp.data import DatasetConfig, DatasetReader, ReturnConfig
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo, echo_lines
from egovcp_collect.dataset.figures import draw_figures, require_matplotlib
from egovcp_collect.dataset.spread import Spread
from egovcp_collect.dataset.survey import EventRate, TaskSurvey, survey
from egovcp_collect.dataset.verdict import Finding, Thresholds, judge, summary


@dataclass(frozen=True)
class CoverageConfig:
    """Event rates, returns, actions, depth and scenes of a dataset, and a verdict.

    Reads all columns but depth, of which it takes a sample. The verdict never fails the
    command: exit 0 says that the dataset could be read.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    output_dir: str = ""
    """Folder for the pictures events.png, returns.png, actions.png, depth.png; empty: none."""
    json: str = output_file()
    """File for the figures and the verdict as JSON; empty: none."""
    returns: ReturnConfig = field(default_factory=ReturnConfig)
    """The Monte Carlo return that Q would be trained on."""
    limits: Thresholds = field(default_factory=Thresholds)
    """What the verdict asks for."""


CONFIG = CoverageConfig


def run(config: CoverageConfig) -> None:
    """Print the coverage and the verdict; draw the pictures.

    Raises:
        DataError: the dataset is damaged.
        EnvironmentFailure: pictures are asked for, and matplotlib is not installed.
    """
    config.returns.check()
    if config.output_dir:
        require_matplotlib()
    reader = DatasetReader.open(config.dataset)
    found = survey(reader, config.returns)
    findings = judge(found, config.limits)
    echo(f"{reader.root}: {len(reader)} episodes, {reader.num_frames} steps\n")
    for task in found.tasks:
        echo_lines([*_describe(task), ""])
    echo_lines(_verdict(findings))
    if config.output_dir:
        for path in draw_figures(found, config.returns, Path(config.output_dir)):
            echo(f"drew {path}")
    if config.json:
        verdict = {
            "worth_training": all(finding.fine for finding in findings),
            "summary": summary(findings),
            "findings": [asdict(finding) for finding in findings],
        }
        write_report(config.json, {"tasks": found.to_json(), "verdict": verdict})


def _verdict(findings: list[Finding]) -> Iterator[str]:
    yield "verdict"
    for finding in findings:
        yield f"  {'ok   ' if finding.fine else 'doubt'}  {finding.task}: {finding.text}"
    yield f"  {summary(findings)}"


def _describe(task: TaskSurvey) -> Iterator[str]:
    yield f"{task.task}: {task.episodes} episodes, {task.steps} steps ({task.step_share:.0%})"
    yield f"  length      {_numbers(task.length, 0)} ticks"
    yield f"  outcome     success {task.success_share:.1%}, fall {task.fall_share:.1%} of episodes"
    yield "  events      ticks per 1000 steps, share of episodes"
    yield from (f"    {name:14}{_rate(rate)}" for name, rate in task.events.items())
    yield f"  reward      {_numbers(task.reward)}"
    r = task.returns
    yield f"  return      {_numbers(r.spread)}; gamma {r.gamma:g}, {r.steps} ticks"
    yield (
        f"              {r.valid_share:.0%} of the rows have one; ahead of them, rewards that "
        f"stand out: {r.positive_share:.1%}, costs: {r.negative_share:.1%}"
    )
    yield "  actions     evenness (0 to 1), targets in m"
    for name, (low, high) in task.action.workspace_m.items():
        yield f"    {name:14}{task.action.uniformity[name]:8.2f}     {low:6.2f} to {high:5.2f}"
    filled = ", ".join(f"{hand} {share:.0%}" for hand, share in task.action.occupied.items())
    yield f"  hand cells  {filled} occupied"
    reached = ", ".join(f"{n} {a:.2f} to {b:.2f}" for n, (a, b) in task.palms_m.items())
    yield f"  palms       98 % within {reached} m"
    d = task.depth
    yield (
        f"  depth       {d.valid_share:.0%} of the pixels valid, {d.near_share:.1%} nearer than "
        f"1 m, median {d.median_m:.2f} m, {d.empty_share:.1%} of the frames empty "
        f"({d.episodes} episodes)"
    )
    yield "  scenes      as drawn"
    for name, spread in task.scene.items():
        yield f"    {name:26}{spread.low:9.3g} to {spread.high:.3g}, mean {spread.mean:.3g}"


def _rate(rate: EventRate) -> str:
    return f"{rate.per_1000_steps:8.2f}   {rate.episode_share:8.1%}"


def _numbers(spread: Spread | None, digits: int = 3) -> str:
    if spread is None:
        return "none"
    parts = [f"{name} {getattr(spread, name):.{digits}f}" for name in ("low", "median", "high")]
    wide = f"5 % {spread.q05:.{digits}f}, 95 % {spread.q95:.{digits}f}"
    return f"{', '.join(parts)}, {wide}, mean {spread.mean:.{digits}f}, std {spread.std:.3f}"
