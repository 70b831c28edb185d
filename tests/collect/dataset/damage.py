"""Ways to damage a dataset: each a function of its root."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from egovcp import spec

type Damage = Callable[[Path], object]

DATA = "data/chunk-000/file-000.parquet"
MORE_DATA = "data/chunk-000/file-001.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
MORE_EPISODES = "meta/episodes/chunk-000/file-001.parquet"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
COLLECTION, HASHES = "meta/collection.json", "meta/sha256.json"


def cut(name: str, keep: float) -> Damage:
    def damage(root: Path) -> None:
        content = (root / name).read_bytes()
        (root / name).write_bytes(content[: int(keep * len(content))])

    return damage


def flip(name: str, at: int) -> Damage:
    """The lowest bit of a byte, counted from the end if negative."""

    def damage(root: Path) -> None:
        content = bytearray((root / name).read_bytes())
        content[at] ^= 0x01
        (root / name).write_bytes(content)

    return damage


def flip_pixel(root: Path) -> None:
    """One bit within the depth images of episode 1, found by its page's place in the file."""
    group = pq.read_metadata(root / DATA).row_group(1)
    page = group.column(0)
    assert page.path_in_schema.startswith(spec.DEPTH_KEY)
    flip(DATA, page.data_page_offset + page.total_compressed_size // 2)(root)


def remove(name: str) -> Damage:
    def damage(root: Path) -> None:
        path = root / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def replace(name: str, content: str) -> Damage:
    return lambda root: (root / name).write_text(content)


def folder(name: str) -> Damage:
    def damage(root: Path) -> None:
        (root / name).unlink()
        (root / name).mkdir()

    return damage


def pipe(name: str) -> Damage:
    """A pipe, which blocks whoever opens it."""

    def damage(root: Path) -> None:
        (root / name).unlink()
        os.mkfifo(root / name)

    return damage


def outside(name: str) -> Damage:
    """The file moved out of the dataset, with a link in its place."""

    def damage(root: Path) -> None:
        target = root.parent / "outside"
        (root / name).rename(target)
        (root / name).symlink_to(target)

    return damage


def swap(one: str, other: str) -> Damage:
    def damage(root: Path) -> None:
        (root / one).rename(root / "aside")
        (root / other).rename(root / one)
        (root / "aside").rename(root / other)

    return damage


def edit(name: str, change: Callable[[Any], object]) -> Damage:
    """Change a JSON file."""

    def damage(root: Path) -> None:
        content = json.loads((root / name).read_text())
        change(content)
        (root / name).write_text(json.dumps(content))

    return damage


def info(**values: object) -> Damage:
    return edit(INFO, lambda content: content.update(values))


def feature(key: str, **values: object) -> Damage:
    return edit(INFO, lambda content: content["features"][key].update(values))


def record(episode: int, **values: object) -> Damage:
    return edit(COLLECTION, lambda content: content["episodes"][episode].update(values))


def statistic(key: str, name: str, value: object) -> Damage:
    return edit(STATS, lambda content: content[key].update({name: value}))


def column(key: str, change: Callable[[list[Any]], object], name: str = DATA) -> Damage:
    """Change the rows of a column, in place, and write the file anew."""

    def damage(root: Path) -> None:
        table = pq.read_table(root / name)
        at = table.schema.get_field_index(key)
        rows = table[key].to_pylist()
        change(rows)
        field = table.schema.field(at)
        rewrite(root / name, table.set_column(at, field, pa.array(rows, field.type)))

    return damage


def retype(key: str, kind: pa.DataType) -> Damage:
    """Store a column as another type."""

    def damage(root: Path) -> None:
        table = pq.read_table(root / DATA)
        at = table.schema.get_field_index(key)
        rows = pa.array(table[key].to_pylist(), kind)
        rewrite(root / DATA, table.set_column(at, key, rows))

    return damage


def rows(choose: Callable[[pa.Table], pa.Table], name: str = DATA) -> Damage:
    """Write a file anew with other rows."""
    return lambda root: rewrite(root / name, choose(pq.read_table(root / name)))


def rewrite(path: Path, table: pa.Table) -> None:
    table = table.replace_schema_metadata(pq.read_schema(path).metadata)
    path.unlink()
    pq.write_table(table, path)


def no_episodes(root: Path) -> None:
    """A table of episodes without a row, and totals that agree."""
    for name in (EPISODES, MORE_EPISODES):
        rows(lambda table: table.slice(0, 0), name)(root)
    info(total_episodes=0, total_frames=0)(root)


def put(index: int, value: object) -> Callable[[list[Any]], None]:
    """Set one row; for a vector, its second element."""

    def change(rows: list[Any]) -> None:
        if isinstance(rows[index], list):
            rows[index][1] = value
        else:
            rows[index] = value

    return change


def blob(index: int, change: Callable[[bytes], bytes | None]) -> Callable[[list[Any]], None]:
    """Change the TIFF of one row."""

    def edit_row(rows: list[Any]) -> None:
        rows[index]["bytes"] = change(rows[index]["bytes"])

    return edit_row


def deeper(image: bytes) -> bytes:
    """A pixel beyond the camera's range."""
    return image[:-2] + np.uint16(6000).tobytes()
