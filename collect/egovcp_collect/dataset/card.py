"""`egovcp-dataset card`: the dataset card, README.md, which the Hub shows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from huggingface_hub import DatasetCard, DatasetCardData

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, ReturnConfig, schema
from egovcp.data.destination import require_outside
from egovcp.data.provenance import Provenance, source_provenances
from egovcp.data.source import hub_cache
from egovcp.errors import UsageError
from egovcp.files import user_path, write_text
from egovcp.help_text import field_docs
from egovcp.hub import is_repo_id
from egovcp.outputs import output_file, require_output_file, require_writable
from egovcp.sim.config import BaseEnvConfig, EnvConfig
from egovcp.sim.tasks.registry import describe_task
from egovcp.terminal import echo
from egovcp_collect.dataset.coverage import assess, coverage_texts, summary
from egovcp_collect.dataset.figures import draw_figures, require_matplotlib
from egovcp_collect.dataset.statistics import DatasetStatistics, TaskStatistics, compute_statistics

CARD: Final = "README.md"
ASSETS: Final = "assets"
_WALK: Final = {"eta", "boundary", "step_ticks"}  # options of the random walk
_PLOTS: Final = ("events", "returns", "actions", "depth")
_GENERAL: Final = {option.name for option in fields(BaseEnvConfig)}  # every pair in them is a range
_COSTS: Final = {"pose_cost", "action_rate_cost"}  # of every robot
_BOUNDARY: Final = {"reflect": "reflected at the faces of the box", "clip": "clipped to the box"}


@dataclass(frozen=True)
class CardConfig:
    """Write a dataset's card: contents, collection, schema, and for the G1 statistics and plots.

    The plots go to `assets/` beside a README.md, and to `assets/NAME/` beside another NAME.md."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    repo_id: str = ""
    """Id on the Hub in the card's examples, `user/name`; empty: the dataset's own."""
    output: str = output_file()
    """File to write; empty: README.md in the dataset's folder."""


def run_card(config: CardConfig) -> None:
    """Write card and plots."""
    require_matplotlib()
    if config.repo_id and not is_repo_id(config.repo_id):
        raise UsageError(f"--repo_id={config.repo_id!r}: expected user/name")
    reader = DatasetReader.open(config.dataset)
    if reader.root.resolve().is_relative_to(hub_cache().resolve()) and not config.output:
        raise UsageError(
            f"{reader.root} is the Hub's cache, which is not changed; give a file: --output=FILE"
        )
    output = user_path(config.output) if config.output else reader.root / CARD
    assets = ASSETS if output.name == CARD else f"{ASSETS}/{output.stem}"
    require_output_file(str(output), "--output")
    require_outside(reader.root, str(output), "--output")
    require_writable(output.parent / assets)
    statistics, paths = _statistics(reader), list[Path]()
    if statistics is not None:
        paths = draw_figures(statistics, ReturnConfig(), output.parent / assets)
    plots = {path.stem: f"{assets}/{path.name}" for path in paths}
    output.parent.mkdir(parents=True, exist_ok=True)
    write_text(output, _render(reader, config.repo_id, statistics, plots))
    echo(f"wrote {output} and {len(paths)} plots in {output.parent / assets}")
    print_missing_licence(reader)


def card_text(reader: DatasetReader, repo_id: str) -> str:
    """The card of a dataset, with the plots in its ``assets``; ``repo_id`` is for the examples."""
    paths = {name: f"{ASSETS}/{name}.png" for name in _PLOTS}
    plots = {name: path for name, path in paths.items() if (reader.root / path).is_file()}
    return _render(reader, repo_id, _statistics(reader), plots)


def print_missing_licence(reader: DatasetReader) -> None:
    """Print a hint if the card names no licence: only that of simulated data is known."""
    if _origin(reader) != "simulated":
        echo(
            "the card names no licence, because the data are not known to be simulated; write the "
            f"card with `egovcp-dataset card` and add `license:` to the top of its {CARD}"
        )


def _origin(reader: DatasetReader) -> str:
    """`Provenance.origin`; empty if it is not known, or not that of all merged datasets."""
    parts = source_provenances(reader.origin)
    origins = {part.origin or _origin_by_command(part) for part in parts}
    return origins.pop() if len(origins) == 1 else ""


def _origin_by_command(part: Provenance) -> str:
    """That of a dataset from before origins were recorded: only egovcp-collect records a seed."""
    is_collected = part.seed is not None and part.command.startswith("egovcp-collect ")
    return "simulated" if is_collected else ""


def _statistics(reader: DatasetReader) -> DatasetStatistics | None:
    """None for another robot than the G1."""
    return compute_statistics(reader, ReturnConfig()) if reader.robot.is_g1 else None


def _render(
    reader: DatasetReader,
    repo_id: str,
    statistics: DatasetStatistics | None,
    plots: Mapping[str, str],
) -> str:
    name = repo_id or reader.source.repo_id or f"user/{reader.root.name}"
    tasks = list(dict.fromkeys(reader.task(i) for i in range(len(reader))))
    provenance, robot = reader.provenance, reader.robot
    parts = source_provenances(reader.origin)
    config, versions = common_settings([part.config for part in parts]), reader.origin.versions
    shortest, longest = config.get("step_ticks", (1, 1))
    env = config.get("env", {})
    if not robot.is_g1:  # sensors and randomisation of the G1 do not apply
        env = {k: v for k, v in env.items() if k.removesuffix("_episode") in {*tasks, *_COSTS}}
    ranges, constants = settings_tables(env, tasks)
    numbers = [reader.metadata(index).get("episode") for index in range(len(reader))]
    checks = assess(statistics) if statistics else []
    robot_tags = [robot.robot_type, *(["humanoid"] if robot.is_g1 else [])]
    card = DatasetCard.from_template(
        DatasetCardData(
            license="apache-2.0" if _origin(reader) == "simulated" else None,
            task_categories=["robotics"],
            tags=["LeRobot", "egovcp", *robot_tags, "depth", "world-model"],
            size_categories=[_size_category(reader.num_frames)],
            pretty_name=name.partition("/")[2],
            configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
        ),
        template_str=(files(__package__) / "card_template.md").read_text(encoding="utf-8"),
        dataset=name.partition("/")[2],
        robot=robot,
        origin=_origin(reader),
        converted_from=config.get("converted_from"),
        features=reader.features,
        reward_terms=spec.REWARD_TERMS,
        rate_limit=spec.ACTION_RATE_LIMIT,
        tasks=[{"name": task, "about": describe_task(task)} for task in tasks],
        episodes=len(reader),
        frames=reader.num_frames,
        hours=f"{reader.num_frames / reader.fps / 3600:.2f}",
        fps=reader.fps,
        codebase_version=schema.CODEBASE_VERSION,
        command=str(provenance.get("command") or "not recorded"),
        seeds=", ".join(dict.fromkeys(str(part.seed) for part in parts if part.seed is not None)),
        merged=len(parts) > 1,
        complete=len(parts) == 1 and numbers == [*range(len(reader))],
        versions=", ".join(f"{k} {v}" for k, v in versions.items()) or "not recorded",
        controller_id=reader.controller_id,
        eta=config.get("eta") if len(parts) == 1 or config.keys() >= _WALK else None,
        boundary=_BOUNDARY.get(config.get("boundary", ""), "kept inside the box"),
        interval=f"{shortest} to {longest}" if longest > 1 else "",
        ranges=ranges,
        constants=constants,
        coverage=coverage_table(statistics.tasks) if statistics else "",
        events=event_table(statistics.tasks) if statistics else "",
        plots=plots,
        assessment=summary(checks),
        failed=[check for check in checks if not check.passed],
        repo_id=name,
    )
    return f"{str(card).rstrip()}\n"


def _size_category(rows: int) -> str:
    """The Hub's name for a number of rows."""
    bounds = ("1K", "10K", "100K", "1M", "10M", "100M", "1B", "10B")
    place = max(0, len(str(rows)) - 3)
    return f"{bounds[place - 1]}<n<{bounds[place]}" if place else "n<1K"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; pipes in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(
        f"| {' | '.join(str(cell).replace('|', r'\|') for cell in line)} |" for line in lines
    )


def common_settings(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The nested settings that are equal in all parts."""
    first, *others = parts
    common = dict[str, Any]()
    for name, value in first.items():
        values = [value, *(other.get(name) for other in others)]
        if all(isinstance(each, Mapping) for each in values):
            common[name] = common_settings(values)
        elif all(each == value for each in values):
            common[name] = value
    return common


def settings_tables(env: Mapping[str, Any], tasks: Sequence[str]) -> tuple[str, str]:
    """Parameters drawn per episode, and constant ones, of the recorded options ``--env.*``."""
    drawn, constant = [], []
    for name, value, meaning in _settings(env, tasks):
        is_range = name.partition(".")[0] in _GENERAL or name.endswith(("_range", ".event_ticks"))
        if is_range and isinstance(value, list) and len(value) == 2:
            low, high = value
            if low != high:
                drawn.append((f"`env.{name}`", _format(low), _format(high), meaning))
                continue
            value = low
        constant.append((f"`env.{name}`", _format(value), meaning))
    head = ("parameter", "from", "to", "meaning")
    return markdown_table(head, drawn), markdown_table(("parameter", "value", "meaning"), constant)


def _settings(env: Mapping[str, Any], tasks: Sequence[str]) -> Iterator[tuple[str, Any, str]]:
    """Dotted name, value and documentation of the settings of these tasks.

    Options unknown to this version get an empty description.
    """
    defaults, docs = EnvConfig(), dict(field_docs(EnvConfig))
    for group, value in env.items():
        own = group in _GENERAL or group.removesuffix("_episode") in tasks
        if group == "threads" or (isinstance(value, Mapping) and not own):
            continue
        if not isinstance(value, Mapping):
            yield group, value, docs.get(group, "")
            continue
        kind = type(getattr(defaults, group, None))
        group_docs = dict(field_docs(kind)) if is_dataclass(kind) else {}
        for name, setting in value.items():
            yield f"{group}.{name}", setting, group_docs.get(name, "")


def _format(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return ", ".join(map(_format, value)) if isinstance(value, list) else str(value)


def coverage_table(tasks: Sequence[TaskStatistics]) -> str:
    """Statistics, one column per task."""
    columns = [coverage_texts(task) for task in tasks]
    rows = [(name, *(column[name] for column in columns)) for name in columns[0]]
    return markdown_table(("", *(task.task for task in tasks)), rows)


def event_table(tasks: Sequence[TaskStatistics]) -> str:
    """Rate of each reward term and contact."""
    rows = [
        (task.task, f"`{name}`", f"{rate.per_1000_ticks:.2f}", f"{rate.episode_share:.1%}")
        for task in tasks
        for name, rate in task.term_rates.items()
    ]
    return markdown_table(("task", "term", "per 1000 ticks", "episodes"), rows)
