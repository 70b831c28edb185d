"""Reads what is needed to append to a dataset."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from egovcp.data import metadata, schema, stats
from egovcp.data.encoded import EncodedEpisode
from egovcp.data.hashes import load_hashes, verify_hashes
from egovcp.data.origin import SOURCES
from egovcp.data.parquet import damaged, open_parquet
from egovcp.data.provenance import Provenance, parse_provenance
from egovcp.data.shard import shard_paths
from egovcp.data.version import Contents
from egovcp.errors import DataError, UsageError


@dataclass(frozen=True)
class Existing:
    """A dataset that can be extended."""

    contents: Contents
    """What the complete shards hold."""
    tail: list[EncodedEpisode]
    """The episodes of the last shard if it is not complete."""
    provenance: Provenance
    next_number: int
    """Number, in the collection, of the episode to append next. More than the number of episodes
    if some were removed."""


def read_version(root: Path) -> Existing:
    """Read what is needed to append to a dataset.

    Raises:
        DataError: the dataset is damaged, or was not written in shards of one size.
        UsageError: it was merged from several collections.
    """
    verify_hashes(root)
    info = metadata.load_info(root)
    table = metadata.load_episode_table(root, info)
    episodes = len(table.length)
    collection = metadata.load_collection(root, table.length)
    size, hashes = collection.get("shard_episodes"), load_hashes(root)
    if not isinstance(size, int) or size < 1 or not hashes:
        raise DataError(
            f"{root} was not written in shards by egovcp and cannot be extended; "
            "`egovcp-dataset repair` writes a copy that can"
        )
    full = episodes // size
    shards = [_episodes_table(root, number) for number in range(-(-episodes // size))]
    matrices = [stats.from_arrow(shard) for shard in shards]
    lengths = [shard["length"].to_pylist() for shard in shards]
    records = collection["episodes"]
    kept = full * size
    names = [name for number in range(full) for name in shard_paths(number)]
    names_by_index = metadata.load_tasks(root)
    contents = Contents(
        size,
        [json.dumps(record) for record in records[:kept]],
        int(table.length[:kept].sum()),
        _tasks(records[:kept], names_by_index),
        [(stats.aggregate(matrices[n], lengths[n]), sum(lengths[n])) for n in range(full)],
        {name: hashes[name] for name in names},
    )
    tail = _tail(root, full, records[kept:], matrices[full]) if kept < episodes else []
    provenance = parse_provenance(collection, root / schema.COLLECTION_PATH)
    return Existing(contents, tail, provenance, _next_number(root, provenance, records))


def _next_number(root: Path, provenance: Provenance, records: list[dict[str, Any]]) -> int:
    """After the highest number, so that no episode is collected twice."""
    path = root / schema.COLLECTION_PATH
    elsewhere = (
        f"{root} holds episodes of several collections and cannot be extended; collect into "
        "another folder, then join the two with `egovcp-dataset merge`"
    )
    if SOURCES in provenance.config:
        raise UsageError(elsewhere)
    first: dict[int, int] = {}  # episode number -> index in the dataset
    for index, record in enumerate(records):
        facts = record.get("metadata", {})
        number = facts.get("episode", index)
        if not isinstance(number, int) or isinstance(number, bool) or number < 0:
            raise DataError.at(path, f"its number is {number!r}, expected an integer", index)
        if facts.get("seed", provenance.seed) != provenance.seed:
            raise UsageError(elsewhere)
        if first.setdefault(number, index) != index:
            problem = f"is number {number} of the collection, and so is episode {first[number]}"
            raise DataError.at(path, f"{problem}; `egovcp-dataset repair` keeps one", index)
    return max(first, default=-1) + 1


def _episodes_table(root: Path, number: int) -> pa.Table:
    path = root / shard_paths(number)[1]
    with damaged(path):
        return open_parquet(path).read()


def _tasks(records: list[dict[str, Any]], names: dict[int, str]) -> dict[str, int]:
    """Task -> index of the tasks that these episodes have."""
    present = {record["task"] for record in records}
    return {name: index for index, name in sorted(names.items()) if name in present}


def _tail(
    root: Path, number: int, records: list[dict[str, Any]], matrices: list[stats.Matrix]
) -> list[EncodedEpisode]:
    path = root / shard_paths(number)[0]
    ordered = schema.episode_schema()
    with damaged(path):
        file = open_parquet(path)
        tables = [
            file.read_row_group(i, columns=ordered.names).select(ordered.names).cast(ordered)
            for i in range(len(records))
        ]
    return [
        EncodedEpisode(table, record, matrix[:, stats.DATA_COLUMNS])
        for table, record, matrix in zip(tables, records, matrices, strict=True)
    ]
