"""`egovcp-dataset info`: what a dataset holds and how it was collected."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from egovcp.data import DatasetConfig, DatasetReader
from egovcp.data.index import HELDOUT_FRACTION, in_split
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo_lines


@dataclass(frozen=True)
class DatasetInfoConfig:
    """Print what a dataset holds and how it was collected, without reading its frames."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    json: str = output_file()
    """File for the same information as JSON; empty: none."""


def run_info(config: DatasetInfoConfig) -> None:
    """Print the information."""
    info = describe(DatasetReader.open(config.dataset))
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
        "bytes": sum(p.stat().st_size for p in reader.root.rglob("*") if p.is_file()),
        "controller_id": reader.controller_id,
        "seed": provenance.get("seed"),
        "command": provenance.get("command", ""),
        "versions": dict(provenance.get("versions", {})),
        "features": {
            key: {"dtype": f["dtype"], "shape": list(f["shape"])}
            for key, f in reader.info["features"].items()
        },
    }


def _table(info: dict[str, Any]) -> list[str]:
    versions = ", ".join(f"{k} {v}" for k, v in info["versions"].items())
    rows = [
        ("dataset", info["root"]),
        ("Hub", f"{info['repo_id']}@{info['commit']}" if info["commit"] else "no, a folder"),
        ("episodes", f"{info['episodes']}, {info['heldout_episodes']} of them held out"),
        *(
            (f"  {task}", f"{count['episodes']} episodes, {count['frames']} frames")
            for task, count in info["tasks"].items()
        ),
        ("frames", f"{info['frames']} at {info['fps']} Hz, {info['hours']:.2f} h"),
        ("size", f"{info['bytes'] / 1e6:.1f} MB"),
        ("controller", info["controller_id"]),
        ("seed", "several" if info["seed"] is None else info["seed"]),
        ("command", info["command"] or "not recorded"),
        ("versions", versions or "not recorded"),
        ("features", ""),
        *((f"  {key}", f"{f['dtype']} {f['shape']}") for key, f in info["features"].items()),
    ]
    width = max(len(name) for name, _ in rows)
    return [f"{name:{width}}  {value}".rstrip() for name, value in rows]
