"""`egovcp-dataset info`: what a dataset holds and how it was collected."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from egovcp.data import DatasetConfig, DatasetReader, schema
from egovcp.data.index import HELDOUT_FRACTION, in_split
from egovcp.data.lerobot import LeRobotReader, is_own
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
    if is_own(source.root):
        info = describe(DatasetReader.open(config.dataset))
    else:
        info = describe_other(LeRobotReader.open(source.root), source)
    echo_lines(_table(info))
    write_report(config.json, info)


def describe(reader: DatasetReader) -> dict[str, Any]:
    """The information, JSON-compatible."""
    tasks = [reader.task(i) for i in range(len(reader))]
    episodes, frames = Counter(tasks), Counter[str]()
    for task, length in zip(tasks, reader.lengths.tolist(), strict=True):
        frames[task] += length
    identities = [reader.identity(i) for i in range(len(reader))]
    provenance = reader.provenance
    return {
        "root": str(reader.root),
        "repo_id": reader.source.repo_id,
        "commit": reader.source.commit,
        "tasks": {t: {"episodes": episodes[t], "frames": frames[t]} for t in sorted(episodes)},
        "episodes": len(reader),
        "frames": reader.num_frames,
        "hours": reader.num_frames / reader.fps / 3600,
        "fps": reader.fps,
        "heldout_episodes": sum(in_split(identities, "heldout", HELDOUT_FRACTION)),
        "bytes": _bytes(reader.root),
        "controller_id": reader.controller_id,
        "seed": provenance.get("seed"),
        "command": provenance.get("command", ""),
        "versions": dict(provenance.get("versions", {})),
        "features": _features(reader.info),
    }


def describe_other(reader: LeRobotReader, source: Source) -> dict[str, Any]:
    """The information on a dataset that egovcp did not collect, JSON-compatible. An episode counts
    for each of its tasks."""
    episodes, frames = Counter[str](), Counter[str]()
    for row in reader.rows:
        for task in row.tasks:
            episodes[task] += 1
            frames[task] += row.length
    return {
        "root": str(reader.root),
        "repo_id": source.repo_id,
        "commit": source.commit,
        "tasks": {t: {"episodes": episodes[t], "frames": frames[t]} for t in sorted(episodes)},
        "episodes": len(reader.rows),
        "frames": reader.num_frames,
        "hours": reader.num_frames / reader.fps / 3600,
        "fps": reader.fps,
        "bytes": _bytes(reader.root),
        "robot_type": reader.info.get("robot_type"),
        "features": _features(reader.info),
    }


def _bytes(root: Path) -> int:
    return sum(p.stat().st_size for p in root.rglob("*") if p.is_file())


def _features(info: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: {"dtype": f["dtype"], "shape": list(f["shape"])} for key, f in info["features"].items()
    }


def _table(info: dict[str, Any]) -> list[str]:
    heldout = info.get("heldout_episodes")
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
        *(_collection_rows(info) if "controller_id" in info else _other_rows(info)),
        ("features", ""),
        *((f"  {key}", f"{f['dtype']} {f['shape']}") for key, f in info["features"].items()),
    ]
    width = max(len(name) for name, _ in rows)
    return [f"{name:{width}}  {value}".rstrip() for name, value in rows]


def _collection_rows(info: dict[str, Any]) -> list[tuple[str, object]]:
    versions = ", ".join(f"{k} {v}" for k, v in info["versions"].items())
    return [
        ("controller", info["controller_id"]),
        ("seed", "several" if info["seed"] is None else info["seed"]),
        ("command", info["command"] or "not recorded"),
        ("versions", versions or "not recorded"),
    ]


def _other_rows(info: dict[str, Any]) -> list[tuple[str, object]]:
    return [
        ("robot", info["robot_type"] or "not recorded"),
        ("collection", f"not recorded: there is no {schema.COLLECTION_PATH}"),
    ]
