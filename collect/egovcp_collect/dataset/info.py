"""`egovcp-dataset info`: what a dataset holds and how it came to be."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from egovcp.data import DatasetConfig, DatasetReader
from egovcp.data.index import HELDOUT_FRACTION, in_split
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo_lines


@dataclass(frozen=True)
class InfoConfig:
    """Say what a dataset holds and how it was collected, without reading its frames."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, or an id of the Hub."""
    json: str = output_file()
    """File for the same facts as JSON; empty: none."""


CONFIG = InfoConfig


def run(config: InfoConfig) -> None:
    """Print the facts.

    Raises:
        DataError: the dataset is incomplete, or of another specification.
    """
    facts = describe(DatasetReader.open(config.dataset))
    echo_lines(_table(facts))
    write_report(config.json, facts)


def describe(reader: DatasetReader) -> dict[str, Any]:
    """The facts under flat keys, JSON-compatible."""
    identities = [reader.identity(i) for i in range(len(reader))]
    frames: Counter[str] = Counter()
    for i in range(len(reader)):
        frames[reader.task(i)] += int(reader.lengths[i])
    episodes = Counter(reader.task(i) for i in range(len(reader)))
    known = reader.provenance
    return {
        "root": str(reader.root),
        "repo_id": reader.source.repo_id,
        "commit": reader.source.commit,
        "tasks": {t: {"episodes": episodes[t], "frames": frames[t]} for t in sorted(frames)},
        "episodes": len(reader),
        "frames": reader.num_frames,
        "hours": reader.num_frames / reader.fps / 3600,
        "fps": reader.fps,
        "heldout_episodes": sum(in_split(identities, "heldout", HELDOUT_FRACTION)),
        "bytes": sum(p.stat().st_size for p in reader.root.rglob("*") if p.is_file()),
        "controller_id": reader.controller_id,
        "seed": known.get("seed"),
        "command": known.get("command", ""),
        "versions": dict(known.get("versions", {})),
        "features": {
            key: {"dtype": f["dtype"], "shape": list(f["shape"])}
            for key, f in reader.info["features"].items()
        },
    }


def _table(facts: dict[str, Any]) -> list[str]:
    rows = [
        ("dataset", facts["root"]),
        ("Hub", f"{facts['repo_id']}@{facts['commit']}" if facts["commit"] else "no, a folder"),
        ("episodes", f"{facts['episodes']}, {facts['heldout_episodes']} of them held out"),
        *((f"  {task}", _count(count)) for task, count in facts["tasks"].items()),
        ("frames", f"{facts['frames']} at {facts['fps']} Hz, {facts['hours']:.2f} h"),
        ("size", f"{facts['bytes'] / 1e6:.1f} MB"),
        ("controller", facts["controller_id"]),
        ("seed", "several" if facts["seed"] is None else facts["seed"]),
        ("command", facts["command"] or "not recorded"),
        ("versions", ", ".join(f"{k} {v}" for k, v in facts["versions"].items()) or "not recorded"),
        ("features", ""),
        *((f"  {key}", f"{f['dtype']} {f['shape']}") for key, f in facts["features"].items()),
    ]
    width = max(len(name) for name, _ in rows)
    return [f"{name:{width}}  {value}".rstrip() for name, value in rows]


def _count(count: dict[str, int]) -> str:
    return f"{count['episodes']} episodes, {count['frames']} frames"
