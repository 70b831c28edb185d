"""Damages a dataset in ways that a seed chooses, for the test of what `check` must find.

Whoever can write the files can also write their SHA-256: what is wrong must be found in the
content, so that the list of them is renewed or removed after most mutations.
"""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from egovcp import spec
from egovcp.data import DatasetWriter
from egovcp.data.hashes import write_hashes

from . import damage as d
from .conftest import COLLECTED, walk
from .damage import COLLECTION, DATA, EPISODES, HASHES, INFO, MORE_DATA, MORE_EPISODES, STATS, TASKS

type Random = np.random.Generator
type Mutate = Callable[[Path, Random], str]
"""Damages the dataset; returns the files, separated by ``|``, one of which must be named."""

JSON_FILES: Final = (INFO, STATS, COLLECTION)
PARQUET_FILES: Final = (DATA, MORE_DATA, EPISODES, MORE_EPISODES, TASKS)
ALL_FILES: Final = (*JSON_FILES, *PARQUET_FILES)
#: Damage in one file may first show in another one that contradicts it.
ANY_FILE: Final = "|".join((*ALL_FILES, HASHES))
MARKER: Final = "code-was-executed"
SPARSE_BYTES: Final = 1 << 40


@dataclass(frozen=True)
class Mutation:
    """What was done to a dataset."""

    name: str
    files: tuple[str, ...]
    """Those one of which the refusal must name."""


def mutate(root: Path, seed: int) -> Mutation:
    """Damage a dataset; equal seeds give equal damage, and seeds that follow each other different
    kinds of it."""
    rng = np.random.default_rng(seed)
    function = MUTATIONS[seed % len(MUTATIONS)]
    files = function(root, rng)
    return Mutation(function.__name__.strip("_"), tuple(files.split("|")))


def _pick[T](rng: Random, choices: list[T] | tuple[T, ...]) -> T:
    return choices[int(rng.integers(len(choices)))]


def _settle_hashes(root: Path, rng: Random, renew: bool = True) -> None:
    """Remove the list of SHA-256, or renew it, where files of a moderate size allow it."""
    (root / HASHES).unlink()
    if renew and rng.random() < 0.5:
        write_hashes(root)


# bytes


def _flip_bits(root: Path, rng: Random) -> str:
    name = _pick(rng, (*ALL_FILES, HASHES))
    content = bytearray((root / name).read_bytes())
    for at in rng.integers(len(content), size=int(rng.integers(1, 8))):
        content[at] ^= 1 << int(rng.integers(8))
    (root / name).write_bytes(content)
    return ANY_FILE


def _flip_bits_of_parquet(root: Path, rng: Random) -> str:
    name = _pick(rng, PARQUET_FILES)
    content = bytearray((root / name).read_bytes())
    for at in rng.integers(len(content), size=int(rng.integers(1, 64))):
        content[at] ^= 1 << int(rng.integers(8))
    (root / name).write_bytes(content)
    _settle_hashes(root, rng)
    return ANY_FILE


def _flip_bits_of_a_footer(root: Path, rng: Random) -> str:
    name = _pick(rng, PARQUET_FILES)
    content = bytearray((root / name).read_bytes())
    size = int.from_bytes(content[-8:-4], "little") + 8
    for at in rng.integers(len(content) - size, len(content), size=int(rng.integers(1, 6))):
        content[at] ^= 1 << int(rng.integers(8))
    (root / name).write_bytes(content)
    _settle_hashes(root, rng)
    return ANY_FILE


def _truncate(root: Path, rng: Random) -> str:
    name = _pick(rng, (*ALL_FILES, HASHES))
    os.truncate(root / name, int(rng.integers((root / name).stat().st_size)))
    if name != HASHES:
        _settle_hashes(root, rng)
    return name


def _append(root: Path, rng: Random) -> str:
    name = _pick(rng, ALL_FILES)
    with (root / name).open("ab") as file:
        file.write(rng.bytes(int(rng.integers(16, 4096))))
    _settle_hashes(root, rng)
    return name


def _replace_by_noise(root: Path, rng: Random) -> str:
    name = _pick(rng, ALL_FILES)
    (root / name).write_bytes(rng.bytes(int(rng.integers(0, 4096))))
    _settle_hashes(root, rng)
    return name


# files


def _delete(root: Path, rng: Random) -> str:
    name = _pick(rng, (*ALL_FILES, "data", "meta", "meta/episodes"))
    d.remove(name)(root)
    if name != "meta":
        _settle_hashes(root, rng)
    if name in ("data", "meta"):
        return ANY_FILE
    return f"{name}|meta/episodes" if name.startswith("meta/episodes") else name


def _swap(root: Path, rng: Random) -> str:
    one, other = rng.permutation(list(ALL_FILES))[:2]
    d.swap(str(one), str(other))(root)
    _settle_hashes(root, rng)
    return f"{one}|{other}"


def _replace_by_something_else(root: Path, rng: Random) -> str:
    name = _pick(rng, (*ALL_FILES, HASHES))
    path = root / name
    kind = _pick(rng, ["fifo", "device", "device", "folder", "outside", "loop", "socket", "proc"])
    path.unlink()
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to(_pick(rng, ["/dev/zero", "/dev/stdin", "/dev/full", "/dev/tty"]))
    elif kind == "folder":
        path.mkdir()
    elif kind == "outside":
        path.symlink_to("/etc/passwd")
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "socket":
        os.mknod(path, 0o140644)
    else:
        path.symlink_to("/proc/self/environ")
    if name != HASHES and rng.random() < 0.5:
        (root / HASHES).unlink()
    return name


def _link_a_folder(root: Path, rng: Random) -> str:
    name = _pick(rng, ["data", "meta/episodes", "data/chunk-000"])
    shutil.rmtree(root / name)
    (root / name).symlink_to(_pick(rng, ["/", "/proc", ".", "..", "/nonexistent"]))
    if rng.random() < 0.5:
        (root / HASHES).unlink()
    return "data|meta/episodes"


def _make_huge(root: Path, rng: Random) -> str:
    name = _pick(rng, (*ALL_FILES, HASHES))
    os.truncate(root / name, SPARSE_BYTES if rng.random() < 0.5 else 200 << 20)
    if name != HASHES and rng.random() < 0.5:
        (root / HASHES).unlink()
    return name


def _pad_parquet(root: Path, rng: Random) -> str:
    """A footer that is found only behind a hole."""
    name = _pick(rng, PARQUET_FILES)
    content = (root / name).read_bytes()
    footer = content[-int.from_bytes(content[-8:-4], "little") - 8 :]
    with (root / name).open("r+b") as file:
        file.seek(SPARSE_BYTES)
        file.write(footer)
    if rng.random() < 0.5:
        (root / HASHES).unlink()
    return name


def _add_a_file(root: Path, rng: Random) -> str:
    name = _pick(
        rng,
        [
            b"data/chunk-000/\xff\xfe.parquet",
            b"data/chunk-000/file-002.parquet",
            b"data/extra/file-000.parquet",
            b"data/" + b"x" * 255,
        ],
    )
    path = Path(os.fsdecode(name))
    (root / path).parent.mkdir(exist_ok=True)
    shutil.copyfile(root / DATA, root / path)
    (root / HASHES).unlink()
    return os.fsencode(path).decode("utf-8", "backslashreplace")


# JSON


def _nest_json(root: Path, rng: Random) -> str:
    name = _pick(rng, (*JSON_FILES, HASHES))
    depth = int(rng.integers(1000, 1_000_000))
    opening, closing = _pick(rng, [("[", "]"), ('{"a":', "}")])
    _insert(root, name, opening * depth + "1" + closing * depth)
    if name != HASHES:
        _settle_hashes(root, rng)
    return name


def _write_many_values(root: Path, rng: Random) -> str:
    name = _pick(rng, JSON_FILES)
    _insert(root, name, "[" + ",".join(["[]"] * 1_500_000) + "]")
    _settle_hashes(root, rng)
    return name


def _write_a_constant_that_is_no_json(root: Path, rng: Random) -> str:
    name = _pick(rng, JSON_FILES)
    _insert(root, name, _pick(rng, ["NaN", "Infinity", "-Infinity", "1e999", "1" * 5000]))
    _settle_hashes(root, rng)
    return name


def _insert(root: Path, name: str, value: str) -> None:
    text = (root / name).read_text()
    (root / name).write_text(text.replace("{", f'{{"extra": {value},', 1))


def _write_json_in_another_encoding(root: Path, rng: Random) -> str:
    name = _pick(rng, JSON_FILES)
    text = (root / name).read_text()
    kinds = [
        text.encode("utf-16"),
        text.encode().replace(b"e", b"\xff", 1),
        text.replace("{", '{"\\ud800": 1,', 1).encode(),
        text.encode() + b"\0",
        b"",
    ]
    (root / name).write_bytes(_pick(rng, kinds))
    _settle_hashes(root, rng)
    return name


def _write_something_else_than_an_object(root: Path, rng: Random) -> str:
    name = _pick(rng, (*JSON_FILES, HASHES))
    texts = ["[]", "3", "null", '"text"', "true", "{}", "[{}]"]
    (root / name).write_text(_pick(rng, texts))
    if name != HASHES:
        _settle_hashes(root, rng)
    return name


WRONG: Final[list[Any]] = [
    None, True, False, -1, 10**30, 1e30, 0.5, "", "many", "1", [], {}, [1], [[[]]], {"a": 1},
]  # fmt: skip


def _other(rng: Random, value: object) -> Any:
    """A value of another type or out of any range."""
    wrong = [v for v in WRONG if type(v) is not type(value) or isinstance(v, int)]
    return _pick(rng, [v for v in wrong if v != value])


def _change_info(root: Path, rng: Random) -> str:
    required = ["codebase_version", "fps", "features", "total_episodes", "total_frames"]
    required += ["total_tasks", "data_path", "splits"]

    def change(content: dict[str, Any]) -> None:
        group: Any = content
        key: Any = _pick(rng, required)
        if rng.random() < 0.5:
            feature = content["features"][_pick(rng, list(spec.FEATURES))]
            group, key = feature, _pick(rng, ["dtype", "shape", "names"])
        group[key] = _other(rng, group[key])

    d.edit(INFO, change)(root)
    _settle_hashes(root, rng)
    return INFO


def _leave_the_folder(root: Path, rng: Random) -> str:
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
    d.info(data_path=_pick(rng, paths))(root)
    _settle_hashes(root, rng)
    return f"{INFO}|data/"


def _change_a_record(root: Path, rng: Random) -> str:
    def change(content: dict[str, Any]) -> None:
        record = _pick(rng, content["episodes"])
        key = _pick(rng, ["task", "time_limit", "sha256", "metadata", "length"])
        record[key] = _other(rng, record[key])

    d.edit(COLLECTION, change)(root)
    _settle_hashes(root, rng)
    return f"{COLLECTION}|data/"


def _change_the_provenance(root: Path, rng: Random) -> str:
    names = ["controller_id", "seed", "command", "versions", "config", "spec_version", "episodes"]

    def change(content: dict[str, Any]) -> None:
        key = _pick(rng, names)
        # another seed, command or an empty object is a valid one
        wrong = [v for v in WRONG if type(v) is not type(content[key]) and v is not None]
        content[key] = _pick(rng, wrong)

    d.edit(COLLECTION, change)(root)
    _settle_hashes(root, rng)
    return COLLECTION


def _change_the_sources(root: Path, rng: Random) -> str:
    wrong: list[Any] = [3, "x", {"a": 1}, [3], ["x"], [{}], [{"controller_id": 3}], [None]]
    d.edit(COLLECTION, lambda c: c["config"].update(sources=_pick(rng, wrong)))(root)
    _settle_hashes(root, rng)
    return COLLECTION


def _change_statistics(root: Path, rng: Random) -> str:
    def change(content: dict[str, Any]) -> None:
        feature = content[_pick(rng, list(content))]
        key = _pick(rng, list(feature))
        values = [_other(rng, feature[key]), [1e300], [10**400], ["0.5"], [True], None]
        feature[key] = _pick(rng, values)

    d.edit(STATS, change)(root)
    _settle_hashes(root, rng)
    return STATS


# parquet


def _repeat_rows(root: Path, rng: Random) -> str:
    name = _pick(rng, PARQUET_FILES)
    count = int(rng.integers(1, 4))
    d.rows(lambda t: pa.concat_tables([t, t.slice(0, count)]), name)(root)
    _settle_hashes(root, rng)
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
    name = _pick(rng, PARQUET_FILES)
    d.rows(lambda t: t.slice(int(rng.integers(1, t.num_rows + 1))), name)(root)
    _settle_hashes(root, rng)
    return ANY_FILE


def _change_a_type(root: Path, rng: Random) -> str:
    name = _pick(rng, PARQUET_FILES)
    table = pq.read_table(root / name)
    key = _pick(rng, [n for n in table.column_names if n in _READ])
    kinds = [pa.string(), pa.int8(), pa.float64(), pa.bool_(), pa.binary(), pa.null()]
    kinds = [kind for kind in kinds if kind != table[key].type]
    at = table.column_names.index(key)
    column = pa.nulls(table.num_rows, _pick(rng, kinds))
    d.rewrite(root / name, table.set_column(at, key, column))
    _settle_hashes(root, rng)
    return name


_READ: Final = {
    *spec.FEATURES, "timestamp", "frame_index", "episode_index", "index", "task_index", "task",
    "length", "data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index",
    "tasks",
}  # fmt: skip


def _change_columns(root: Path, rng: Random) -> str:
    name = _pick(rng, PARQUET_FILES)
    table = pq.read_table(root / name)
    names = [n for n in table.column_names if n in _READ]
    key = _pick(rng, names)
    match int(rng.integers(3)):
        case 0:
            table = table.drop_columns([key])
        case 1:
            table = table.rename_columns([n.upper() if n == key else n for n in table.column_names])
        case 2:
            table = table.append_column(key, table[key])
    d.rewrite(root / name, table)
    _settle_hashes(root, rng)
    return name


def _put_a_bad_value(root: Path, rng: Random) -> str:
    row = int(rng.integers(6))
    values: list[Any] = [float("nan"), float("inf"), 3e38, None]
    key = _pick(rng, ["action", "observation.state", "next.reward", "timestamp"])
    d.column(key, d.put(row, _pick(rng, values)))(root)
    _settle_hashes(root, rng)
    return DATA


def _replace_an_image(root: Path, rng: Random) -> str:
    bad: list[bytes | None] = [
        None, b"", b"II*\0" + bytes(8), b"\x89PNG\r\n\x1a\n" + bytes(50), rng.bytes(6266),
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n",
    ]  # fmt: skip
    d.column(spec.DEPTH_KEY, d.blob(int(rng.integers(6)), lambda image: _pick(rng, bad)))(root)
    _settle_hashes(root, rng)
    return DATA


def _damage_an_image(root: Path, rng: Random) -> str:
    """The header of a TIFF: sizes, offsets, compression."""

    def change(image: bytes) -> bytes:
        content = bytearray(image)
        for at in rng.integers(122, size=int(rng.integers(1, 6))):
            content[at] = int(rng.integers(256))
        return bytes(content)

    d.column(spec.DEPTH_KEY, d.blob(int(rng.integers(6)), change))(root)
    _settle_hashes(root, rng)
    return DATA


def _claim_many_rows(root: Path, rng: Random) -> str:
    """Few bytes that decode to millions of rows."""
    name = _pick(rng, [DATA, EPISODES, TASKS])
    table = pq.read_table(root / name)
    first = pa.array(np.zeros(100_000, dtype=int))
    columns = {n: table[n].take(first) for n in _NUMBERS[name]}
    (root / name).unlink()
    pq.write_table(pa.table(columns), root / name, row_group_size=1_000_000)
    _settle_hashes(root, rng)
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
    _settle_hashes(root, rng)
    return DATA


def _claim_absurd_sizes(root: Path, rng: Random) -> str:
    key = _pick(rng, ["length", "dataset_from_index", "dataset_to_index", "data/chunk_index"])
    value = _pick(rng, [2**62, -1, 10**12, 50_001, 0, -(2**63)])
    d.column(key, d.put(0, value), EPISODES)(root)
    if rng.random() < 0.3:
        d.info(total_frames=10**12)(root)
    _settle_hashes(root, rng)
    return f"{EPISODES}|{INFO}|data/"


class _Payload:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (str(self.marker), "w"))


def _pickle_an_extension_type(root: Path, rng: Random) -> str:
    """Arrow types whose metadata older versions of pyarrow unpickled."""
    name = _pick(rng, [DATA, EPISODES])
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
    _settle_hashes(root, rng)
    return name


# nothing that matters


def _change_nothing_that_matters(root: Path, rng: Random) -> str:
    """Other layouts of the same content, which must be accepted."""
    match int(rng.integers(4)):
        case 0:
            name = _pick(rng, JSON_FILES)
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
    _settle_hashes(root, rng)
    return ""


MUTATIONS: Final[tuple[Mutate, ...]] = (
    _flip_bits,
    _flip_bits_of_parquet,
    _flip_bits_of_a_footer,
    _truncate,
    _append,
    _replace_by_noise,
    _delete,
    _swap,
    _replace_by_something_else,
    _link_a_folder,
    _make_huge,
    _pad_parquet,
    _add_a_file,
    _nest_json,
    _write_many_values,
    _write_a_constant_that_is_no_json,
    _write_json_in_another_encoding,
    _write_something_else_than_an_object,
    _change_info,
    _leave_the_folder,
    _change_a_record,
    _change_the_provenance,
    _change_the_sources,
    _change_statistics,
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
