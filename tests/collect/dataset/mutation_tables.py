"""Mutations of parquet files, and other layouts of the same content."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from egovcp import spec
from egovcp.data import DatasetWriter
from tests.support.file_mutations import Random, pick

from . import damage as d
from .conftest import COLLECTED, walk
from .damage import (
    DATA,
    EPISODES,
    INFO,
    MORE_DATA,
    TASKS,
)
from .mutation_editing import (
    ANY_FILE,
    JSON_FILES,
    MARKER,
    PARQUET_FILES,
    Mutate,
    settle_hashes,
)


def _repeat_rows(root: Path, rng: Random) -> str:
    name = pick(rng, PARQUET_FILES)
    count = int(rng.integers(1, 4))
    d.rows(lambda t: pa.concat_tables([t, t.slice(0, count)]), name)(root)
    settle_hashes(root, rng)
    return ANY_FILE


def _repeat_an_episode(root: Path, rng: Random) -> str:
    """As a tool would that copies an episode to the end of the dataset."""

    number = int(rng.integers(3))
    shutil.rmtree(root)
    with DatasetWriter(root, COLLECTED, shard_episodes=2) as writer:
        for n in (0, 1, 2, number):
            writer.add(walk(n, 6))
    return f"{DATA}|{MORE_DATA}"


def _remove_rows(root: Path, rng: Random) -> str:
    name = pick(rng, PARQUET_FILES)
    d.rows(lambda t: t.slice(int(rng.integers(1, t.num_rows + 1))), name)(root)
    settle_hashes(root, rng)
    return ANY_FILE


def _change_a_type(root: Path, rng: Random) -> str:
    name = pick(rng, PARQUET_FILES)
    table = pq.read_table(root / name)
    key = pick(rng, [n for n in table.column_names if n in _READ])
    kinds = [pa.string(), pa.int8(), pa.float64(), pa.bool_(), pa.binary(), pa.null()]
    kinds = [kind for kind in kinds if kind != table[key].type]
    at = table.column_names.index(key)
    column = pa.nulls(table.num_rows, pick(rng, kinds))
    d.rewrite(root / name, table.set_column(at, key, column))
    settle_hashes(root, rng)
    return name


_READ: Final = {
    *spec.FEATURES, "timestamp", "frame_index", "episode_index", "index", "task_index", "task",
    "length", "data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index",
    "tasks",
}  # fmt: skip


def _change_columns(root: Path, rng: Random) -> str:
    name = pick(rng, PARQUET_FILES)
    table = pq.read_table(root / name)
    names = [n for n in table.column_names if n in _READ]
    key = pick(rng, names)
    match int(rng.integers(3)):
        case 0:
            table = table.drop_columns([key])
        case 1:
            table = table.rename_columns([n.upper() if n == key else n for n in table.column_names])
        case 2:
            table = table.append_column(key, table[key])
    d.rewrite(root / name, table)
    settle_hashes(root, rng)
    return name


def _put_a_bad_value(root: Path, rng: Random) -> str:
    row = int(rng.integers(6))
    values: list[Any] = [float("nan"), float("inf"), 3e38, None]
    key = pick(rng, ["action", "observation.state", "next.reward", "timestamp"])
    d.column(key, d.put(row, pick(rng, values)))(root)
    settle_hashes(root, rng)
    return DATA


def _replace_an_image(root: Path, rng: Random) -> str:
    bad: list[bytes | None] = [
        None, b"", b"II*\0" + bytes(8), b"\x89PNG\r\n\x1a\n" + bytes(50), rng.bytes(6266),
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n",
    ]  # fmt: skip
    d.column(spec.DEPTH_KEY, d.blob(int(rng.integers(6)), lambda image: pick(rng, bad)))(root)
    settle_hashes(root, rng)
    return DATA


def _damage_an_image(root: Path, rng: Random) -> str:
    """The header of a TIFF: sizes, offsets, compression."""

    def change(image: bytes) -> bytes:
        content = bytearray(image)
        for at in rng.integers(122, size=int(rng.integers(1, 6))):
            content[at] = int(rng.integers(256))
        return bytes(content)

    d.column(spec.DEPTH_KEY, d.blob(int(rng.integers(6)), change))(root)
    settle_hashes(root, rng)
    return DATA


def _claim_many_rows(root: Path, rng: Random) -> str:
    """Few bytes that decode to millions of rows."""
    name = pick(rng, [DATA, EPISODES, TASKS])
    table = pq.read_table(root / name)
    first = pa.array(np.zeros(100_000, dtype=int))
    columns = {n: table[n].take(first) for n in _NUMBERS[name]}
    (root / name).unlink()
    pq.write_table(pa.table(columns), root / name, row_group_size=1_000_000)
    settle_hashes(root, rng)
    return name


_NUMBERS: Final = {
    DATA: ["action", "index"],
    EPISODES: ["episode_index", "length", "data/chunk_index", "data/file_index"],
    TASKS: ["task_index"],
}


def _compress_gigabytes(root: Path, rng: Random) -> str:
    """One image or list that is far too long, compressed to nothing."""
    table = pq.read_table(root / DATA)
    if rng.random() < 0.5:
        rows = table[spec.DEPTH_KEY].to_pylist()
        rows[3]["bytes"] = bytes(24 << 20)
        column = pa.array(rows, table.schema.field(spec.DEPTH_KEY).type)
        at = table.column_names.index(spec.DEPTH_KEY)
        table = table.set_column(at, table.schema.field(at), column)
    else:
        lists = [np.zeros(7, np.float32)] * table.num_rows
        lists[2] = np.zeros(4_000_000, np.float32)
        at = table.column_names.index("action")
        table = table.set_column(at, "action", pa.array(lists, pa.list_(pa.float32())))
    (root / DATA).unlink()
    pq.write_table(table, root / DATA, compression="zstd")
    settle_hashes(root, rng)
    return DATA


def _claim_absurd_sizes(root: Path, rng: Random) -> str:
    key = pick(rng, ["length", "dataset_from_index", "dataset_to_index", "data/chunk_index"])
    value = pick(rng, [2**62, -1, 10**12, 50_001, 0, -(2**63)])
    d.column(key, d.put(0, value), EPISODES)(root)
    if rng.random() < 0.3:
        d.info(total_frames=10**12)(root)
    settle_hashes(root, rng)
    return f"{EPISODES}|{INFO}|data/"


class _Payload:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (str(self.marker), "w"))


def _pickle_an_extension_type(root: Path, rng: Random) -> str:
    """Arrow types whose metadata older versions of pyarrow unpickled."""
    name = pick(rng, [DATA, EPISODES])
    table = pq.read_table(root / name)
    key = "action" if name == DATA else "length"
    metadata = {
        b"ARROW:extension:name": b"arrow.py_extension_type",
        b"ARROW:extension:metadata": pickle.dumps(_Payload(root.parent / MARKER)),
    }
    at = table.column_names.index(key)
    field = pa.field(key, pa.string(), metadata=metadata)
    column = pa.array(["x"] * table.num_rows)
    d.rewrite(root / name, table.set_column(at, field, column))
    settle_hashes(root, rng)
    return name


def _change_nothing_that_matters(root: Path, rng: Random) -> str:
    """Other layouts of the same content, which must be accepted."""
    match int(rng.integers(4)):
        case 0:
            name = pick(rng, JSON_FILES)
            content = json.loads((root / name).read_text())
            (root / name).write_text(json.dumps(content, sort_keys=True))
        case 1:
            table = pq.read_table(root / DATA)
            schema_metadata = pq.read_schema(root / DATA).metadata
            table = table.replace_schema_metadata(schema_metadata)
            pq.write_table(table, root / DATA, row_group_size=5, compression="zstd")
        case 2:
            d.info(extra={"note": "x" * 1000})(root)
        case 3:
            for path in [p for p in root.rglob("*") if p.is_file()]:
                path.with_name(f"._{path.name}").write_bytes(
                    b"\0\5\x16\7\0\2\0\0Mac OS X" + bytes(99)
                )
            (root / "data" / ".DS_Store").write_bytes(bytes(6148))
    settle_hashes(root, rng)
    return ""


TABLE_MUTATIONS: Final[tuple[Mutate, ...]] = (
    _repeat_rows,
    _repeat_an_episode,
    _remove_rows,
    _change_a_type,
    _change_columns,
    _put_a_bad_value,
    _replace_an_image,
    _damage_an_image,
    _claim_many_rows,
    _compress_gigabytes,
    _claim_absurd_sizes,
    _pickle_an_extension_type,
    _change_nothing_that_matters,
)
