"""`egovcp-dataset info`: what a dataset holds and how it was collected."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from egovcp.data import DatasetConfig, DatasetReader, schema
from egovcp.data.destination import require_outside
from egovcp.data.index import in_split
from egovcp.data.lerobot import LeRobotReader, is_own
from egovcp.data.provenance import source_provenances
from egovcp.data.source import Source, locate
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo_lines


@dataclass(frozen=True)
class DatasetInfoConfig:
    """Print what a dataset holds and how it was collected, without reading its frames.

    Of a LeRobot v3 dataset that egovcp did not collect, the robot is printed in place of the
    controller."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    json: str = output_file()
    """File for the same information as JSON; empty: none."""


def run_info(config: DatasetInfoConfig) -> None:
    """Print the information."""
    source = locate(config.dataset)
    require_outside(source.root, config.json)
    if is_own(source.root):
        info = describe(DatasetReader.open_source(source))
    else:
        info = describe_other(LeRobotReader.open(source.root), source)
    write_report(config.json, info)
    echo_lines(_table(info))


def describe(reader: DatasetReader) -> dict[str, Any]:
    """The information, JSON-compatible."""
    lengths = enumerate(reader.lengths.tolist())
    identities = [reader.identity(i) for i in range(len(reader))]
    provenance, parts = reader.provenance, source_provenances(reader.origin)
    return {
        **_contents(reader, reader.source, [(reader.task(i), length) for i, length in lengths]),
        "episodes": len(reader),
        "heldout_episodes": sum(in_split(identities, "heldout")),
        "controller_id": reader.controller_id,
        "seed": provenance.get("seed"),
        "seeds": list(dict.fromkeys(part.seed for part in parts if part.seed is not None)),
        "command": provenance.get("command", ""),
        "versions": dict(provenance.get("versions", {})),
    }


def describe_other(reader: LeRobotReader, source: Source) -> dict[str, Any]:
    """The information on a dataset that egovcp did not collect, JSON-compatible. An episode counts
    for each of its tasks."""
    tasks = [(task, row.length) for row in reader.rows for task in row.tasks]
    return {
        **_contents(reader, source, tasks),
        "episodes": len(reader.rows),
        "robot_type": reader.info.get("robot_type"),
    }


def _contents(
    reader: DatasetReader | LeRobotReader, source: Source, tasks: Sequence[tuple[str, int]]
) -> dict[str, Any]:
    """What is known of every dataset; ``tasks`` has the task and length of each episode."""
    episodes, frames = Counter(task for task, _ in tasks), Counter[str]()
    for task, length in tasks:
        frames[task] += length
    return {
        "root": str(reader.root),
        "repo_id": source.repo_id,
        "commit": source.commit,
        "tasks": {t: {"episodes": episodes[t], "frames": frames[t]} for t in sorted(episodes)},
        "frames": reader.num_frames,
        "hours": reader.num_frames / reader.fps / 3600,
        "fps": reader.fps,
        "bytes": sum(p.stat().st_size for p in reader.root.rglob("*") if p.is_file()),
        "features": {
            key: {"dtype": f["dtype"], "shape": list(f["shape"])}
            for key, f in reader.info["features"].items()
        },
    }


def _table(info: dict[str, Any]) -> list[str]:
    heldout = info.get("heldout_episodes")
    origin: list[tuple[str, object]]
    if "controller_id" in info:
        seeds = info["seeds"]
        versions = ", ".join(f"{k} {v}" for k, v in info["versions"].items())
        origin = [
            ("controller", info["controller_id"]),
            ("seed", "several" if len(seeds) > 1 else seeds[0] if seeds else "none"),
            ("command", info["command"] or "not recorded"),
            ("versions", versions or "not recorded"),
        ]
    else:
        origin = [
            ("robot", info["robot_type"] or "not recorded"),
            ("collection", f"not recorded: there is no {schema.COLLECTION_PATH}"),
        ]
    rows = [
        ("dataset", info["root"]),
        ("Hub", f"{info['repo_id']}@{info['commit']}" if info["commit"] else "no, a folder"),
        ("episodes", f"{info['episodes']}" + (f", {heldout} of them held out" if heldout else "")),
        *(
            (f"  {task}", f"{count['episodes']} episodes, {count['frames']} frames")
            for task, count in info["tasks"].items()
        ),
        ("frames", f"{info['frames']} at {info['fps']:g} Hz, {info['hours']:.2f} h"),
        ("size", f"{info['bytes'] / 1e6:.1f} MB"),
        *origin,
        ("features", ""),
        *((f"  {key}", f"{f['dtype']} {f['shape']}") for key, f in info["features"].items()),
    ]
    width = max(len(name) for name, _ in rows)
    return [f"{name:{width}}  {value}".rstrip() for name, value in rows]
