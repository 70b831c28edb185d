"""`egovcp-dataset card`: the README.md that tells others what a dataset is."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from huggingface_hub import DatasetCard, DatasetCardData

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, ReturnConfig, schema
from egovcp.errors import UsageError
from egovcp.files import write_text
from egovcp.outputs import output_file
from egovcp.terminal import echo
from egovcp_collect.dataset import card_tables
from egovcp_collect.dataset.figures import draw_figures, require_matplotlib
from egovcp_collect.dataset.survey import Survey, survey
from egovcp_collect.dataset.verdict import Thresholds, judge

CARD: Final = "README.md"
ASSETS: Final = "assets"
PICTURES: Final = ("events", "returns", "actions", "depth")
_ABOUT: Final = {
    "ball": "block a thrown ball with hand or wrist before it meets the body",
    "wall": "brace with the hands on a wall that one is pushed towards",
    "arch": "walk up to an arch that is too low for an upright robot, and duck under it",
}
_BOUNDARY: Final = {
    "reflect": "reflected at the walls of the box",
    "clip": "clipped to the box",
}


@dataclass(frozen=True)
class CardConfig:
    """Write a dataset's card: what it is, how it was collected, its schema, figures, pictures."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    repo_id: str = ""
    """Id on the Hub that the card's examples name, `user/name`; empty: the dataset's own."""
    output: str = output_file()
    """File to write; empty: README.md in the dataset's folder."""
    assets: str = ASSETS
    """Folder for the pictures, relative to the card."""


CONFIG = CardConfig


def run(config: CardConfig) -> None:
    """Write card and pictures.

    Raises:
        UsageError: the dataset came from the Hub, and no output is named.
        EnvironmentFailure: matplotlib is not installed.
        DataError: the dataset is damaged.
    """
    require_matplotlib()
    reader = DatasetReader.open(config.dataset)
    if reader.source.commit and not config.output:
        raise UsageError(
            f"{reader.root} is the Hub's cache and stays as it is; name a file by --output"
        )
    output = Path(os.path.expanduser(config.output)) if config.output else reader.root / CARD
    found = survey(reader, ReturnConfig())
    paths = draw_figures(found, ReturnConfig(), output.parent / config.assets)
    pictures = {path.stem: f"{config.assets}/{path.name}" for path in paths}
    output.parent.mkdir(parents=True, exist_ok=True)
    write_text(output, _render(reader, config.repo_id, found, pictures))
    echo(f"wrote {output} and {len(paths)} pictures in {output.parent / config.assets}")


def card_text(reader: DatasetReader, repo_id: str) -> str:
    """The card of a dataset; it shows the pictures that lie in the dataset's ``assets``.

    Args:
        reader: the dataset.
        repo_id: id on the Hub, `user/name`, that the examples name; empty: the dataset's own.

    Raises:
        DataError: the dataset is damaged.
    """
    there = {name: f"{ASSETS}/{name}.png" for name in PICTURES}
    pictures = {name: path for name, path in there.items() if (reader.root / path).is_file()}
    return _render(reader, repo_id, survey(reader, ReturnConfig()), pictures)


def _render(reader: DatasetReader, repo_id: str, found: Survey, pictures: Mapping[str, str]) -> str:
    name = repo_id or reader.source.repo_id or f"user/{reader.root.name}"
    tasks = [task.task for task in found.tasks]
    config = reader.provenance.get("config", {})
    ranges, constants = card_tables.settings_tables(config, tasks)
    card = DatasetCard.from_template(
        _front_matter(name, reader.num_frames),
        template_str=_template(),
        title=f"{name.partition('/')[2]}: Unitree G1, {_list(tasks)}",
        tasks=[{"name": task, "about": _ABOUT[task]} for task in tasks],
        episodes=len(reader),
        steps=reader.num_frames,
        hours=f"{reader.num_frames / reader.fps / 3600:.2f}",
        fps=reader.fps,
        codebase_version=schema.CODEBASE_VERSION,
        **_origin(reader),
        eta=config.get("eta", spec.ACTION_ETA),
        boundary=_BOUNDARY.get(config.get("boundary", ""), "kept inside the box"),
        step_ticks=_step_ticks(config),
        ranges=ranges,
        constants=constants,
        features=card_tables.feature_table(),
        state=card_tables.state_table(),
        state_dim=spec.STATE_DIM,
        action=card_tables.action_table(),
        coverage=card_tables.coverage_table(found.tasks),
        events=card_tables.event_table(found.tasks),
        pictures=pictures,
        findings=judge(found, Thresholds()),
        repo_id=name,
        rows=spec.DEPTH_ROWS,
        cols=spec.DEPTH_COLS,
    )
    return f"{str(card).rstrip()}\n"


def _step_ticks(config: Mapping[str, Any]) -> str:
    """What the card says of a walk that does not step at every tick."""
    least, most = config.get("step_ticks", (1, 1))
    return "" if most == 1 else f", a step every {least} to {most} ticks"


def _origin(reader: DatasetReader) -> dict[str, str]:
    known = reader.provenance
    versions = known.get("versions", {})
    return {
        "command": str(known.get("command") or "not recorded"),
        "seed": str(known.get("seed")),
        "versions": ", ".join(f"{k} {v}" for k, v in versions.items()) or "not recorded",
        "controller_id": reader.controller_id,
    }


def _front_matter(name: str, frames: int) -> DatasetCardData:
    return DatasetCardData(
        license="apache-2.0",
        task_categories=["robotics"],
        tags=["LeRobot", "egovcp", "unitree_g1", "humanoid", "depth", "world-model"],
        size_categories=[_size_category(frames)],
        pretty_name=name.partition("/")[2],
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )


def _size_category(rows: int) -> str:
    """The Hub's word for how many rows there are."""
    bounds = {1_000: "n<1K", 10_000: "1K<n<10K", 100_000: "10K<n<100K", 1_000_000: "100K<n<1M"}
    return next((word for bound, word in bounds.items() if rows < bound), "1M<n<10M")


def _template() -> str:
    return (files(__package__) / "card_template.md").read_text(encoding="utf-8")


def _list(names: Sequence[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
