"""Mutations of JSON files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from egovcp import spec
from tests.support.file_mutations import Random, json_mutations, pick

from .damage import COLLECTION, HASHES, INFO, STATS, edit, info
from .mutation_editing import (
    JSON_FILES,
    Mutate,
    settle_hashes,
)


def _write(root: Path, name: str, content: str | bytes, rng: Random) -> None:
    (root / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    if name != HASHES:
        settle_hashes(root, rng)


WRONG: Final[list[Any]] = [
    None, True, False, -1, 10**30, 1e30, 0.5, "", "many", "1", [], {}, [1], [[[]]], {"a": 1},
]  # fmt: skip


def _other(rng: Random, value: object) -> Any:
    """A value of `WRONG` of another type, or an integer, that differs from `value`."""
    wrong = [v for v in WRONG if type(v) is not type(value) or isinstance(v, int)]
    return pick(rng, [v for v in wrong if v != value])


def _change_info(root: Path, rng: Random) -> str:
    required = ["codebase_version", "fps", "features", "total_episodes", "total_frames"]
    required += ["total_tasks", "data_path", "splits"]

    def change(content: dict[str, Any]) -> None:
        group: Any = content
        key: Any = pick(rng, required)
        if rng.random() < 0.5:
            feature = content["features"][pick(rng, list(spec.FEATURES))]
            group, key = feature, pick(rng, ["dtype", "shape", "names"])
        group[key] = _other(rng, group[key])

    edit(INFO, change)(root)
    settle_hashes(root, rng)
    return INFO


def _change_data_path(root: Path, rng: Random) -> str:
    paths = [
        "../../etc/passwd",
        "/etc/passwd",
        "data/../../x-{chunk_index}",
        "data/{chunk_index.__class__}/{file_index}",
        "data/{chunk_index:999999999d}.parquet",
        "data/{0}.parquet",
        "data/" + "x" * 100_000,
        "data/.hidden/{file_index}.parquet",
        "data/\0.parquet",
        "data/chunk-{chunk_index:03d}/file-{chunk_index:03d}.parquet",
    ]
    info(data_path=pick(rng, paths))(root)
    settle_hashes(root, rng)
    return f"{INFO}|data/"


def _change_a_record(root: Path, rng: Random) -> str:
    def change(content: dict[str, Any]) -> None:
        record = pick(rng, content["episodes"])
        key = pick(rng, ["task", "time_limit", "sha256", "metadata", "length"])
        record[key] = _other(rng, record[key])

    edit(COLLECTION, change)(root)
    settle_hashes(root, rng)
    return f"{COLLECTION}|data/"


def _change_the_provenance(root: Path, rng: Random) -> str:
    names = ["controller_id", "seed", "command", "versions", "config", "spec_version", "episodes"]

    def change(content: dict[str, Any]) -> None:
        key = pick(rng, names)
        # A value of the same type, or null, can be valid.
        wrong = [v for v in WRONG if type(v) is not type(content[key]) and v is not None]
        content[key] = pick(rng, wrong)

    edit(COLLECTION, change)(root)
    settle_hashes(root, rng)
    return COLLECTION


def _change_the_sources(root: Path, rng: Random) -> str:
    wrong: list[Any] = [3, "x", {"a": 1}, [3], ["x"], [{}], [{"controller_id": 3}], [None]]
    edit(COLLECTION, lambda c: c["config"].update(sources=pick(rng, wrong)))(root)
    settle_hashes(root, rng)
    return COLLECTION


def _change_statistics(root: Path, rng: Random) -> str:
    def change(content: dict[str, Any]) -> None:
        feature = content[pick(rng, list(content))]
        key = pick(rng, list(feature))
        values = [_other(rng, feature[key]), [1e300], [10**400], ["0.5"], [True], None]
        feature[key] = pick(rng, values)

    edit(STATS, change)(root)
    settle_hashes(root, rng)
    return STATS


TEXT_MUTATIONS: Final[tuple[Mutate, ...]] = (
    *json_mutations((*JSON_FILES, HASHES), _write),
    _change_info,
    _change_data_path,
    _change_a_record,
    _change_the_provenance,
    _change_the_sources,
    _change_statistics,
)
