"""Reads a dataset back so far that its next version can be built."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from egovcp.data import metadata, schema, stats
from egovcp.data.encoded import EncodedEpisode
from egovcp.data.hashes import load_hashes, verify_hashes
from egovcp.data.provenance import Provenance
from egovcp.data.shard import shard_paths
from egovcp.data.version import Contents
from egovcp.errors import DataError


def read_provenance(collection: dict[str, Any]) -> Provenance:
    """The provenance that ``meta/collection.json`` holds beside the episodes."""
    names = Provenance.__dataclass_fields__
    return Provenance(**{name: collection[name] for name in names if name in collection})


def read_version(root: Path) -> tuple[Contents, list[EncodedEpisode], Provenance]:
    """What the complete shards hold, the episodes of the last one if it is not complete, and the
    provenance.

    Raises:
        DataError: the dataset is damaged, or was not written in shards of one size.
    """
    verify_hashes(root)
    info = metadata.load_info(root)
    table = metadata.load_episode_table(root, info)
    episodes = len(table.length)
    collection = metadata.load_collection(root, table.length)
    size = collection.get("shard_episodes")
    if not isinstance(size, int) or size < 1 or not load_hashes(root):
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
        {name: load_hashes(root)[name] for name in names},
    )
    tail = _tail(root, full, records[kept:], matrices[full]) if kept < episodes else []
    return contents, tail, read_provenance(collection)


def _episodes_table(root: Path, number: int) -> pa.Table:
    path = root / shard_paths(number)[1]
    with metadata.damaged(path):
        return pq.ParquetFile(path).read()


def _tasks(records: list[dict[str, Any]], names: dict[int, str]) -> dict[str, int]:
    """Task -> index of the tasks that these episodes have."""
    present = {record["task"] for record in records}
    return {name: index for index, name in sorted(names.items()) if name in present}


def _tail(
    root: Path, number: int, records: list[dict[str, Any]], matrices: list[stats.Matrix]
) -> list[EncodedEpisode]:
    path = root / shard_paths(number)[0]
    ordered = schema.episode_schema()
    with metadata.damaged(path):
        file = pq.ParquetFile(path)
        tables = [
            file.read_row_group(i, columns=ordered.names).select(ordered.names).cast(ordered)
            for i in range(len(records))
        ]
    return [
        EncodedEpisode(table, record, matrix[:, stats.DATA_COLUMNS])
        for table, record, matrix in zip(tables, records, matrices, strict=True)
    ]
