"""Mutations of bytes, files and folders."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Final

from tests.support.file_mutations import Random, flip_bits, pick

from . import damage as d
from .damage import (
    DATA,
    HASHES,
)
from .mutation_editing import (
    ALL_FILES,
    ANY_FILE,
    PARQUET_FILES,
    SPARSE_BYTES,
    Mutate,
    settle_hashes,
)


def _flip_bits(root: Path, rng: Random) -> str:
    name = pick(rng, (*ALL_FILES, HASHES))
    flip_bits(root / name, rng, 7)
    return ANY_FILE


def _flip_bits_of_parquet(root: Path, rng: Random) -> str:
    name = pick(rng, PARQUET_FILES)
    flip_bits(root / name, rng, 63)
    settle_hashes(root, rng)
    return ANY_FILE


def _flip_bits_of_a_footer(root: Path, rng: Random) -> str:
    name = pick(rng, PARQUET_FILES)
    content = bytearray((root / name).read_bytes())
    size = int.from_bytes(content[-8:-4], "little") + 8
    for at in rng.integers(len(content) - size, len(content), size=int(rng.integers(1, 6))):
        content[at] ^= 1 << int(rng.integers(8))
    (root / name).write_bytes(content)
    settle_hashes(root, rng)
    return ANY_FILE


def _truncate(root: Path, rng: Random) -> str:
    name = pick(rng, (*ALL_FILES, HASHES))
    os.truncate(root / name, int(rng.integers((root / name).stat().st_size)))
    if name != HASHES:
        settle_hashes(root, rng)
    return name


def _append(root: Path, rng: Random) -> str:
    name = pick(rng, ALL_FILES)
    with (root / name).open("ab") as file:
        file.write(rng.bytes(int(rng.integers(16, 4096))))
    settle_hashes(root, rng)
    return name


def _replace_by_noise(root: Path, rng: Random) -> str:
    name = pick(rng, ALL_FILES)
    (root / name).write_bytes(rng.bytes(int(rng.integers(0, 4096))))
    settle_hashes(root, rng)
    return name


def _delete(root: Path, rng: Random) -> str:
    name = pick(rng, (*ALL_FILES, "data", "meta", "meta/episodes"))
    d.remove(name)(root)
    if name != "meta":
        settle_hashes(root, rng)
    if name in ("data", "meta"):
        return ANY_FILE
    return f"{name}|meta/episodes" if name.startswith("meta/episodes") else name


def _swap(root: Path, rng: Random) -> str:
    one, other = rng.permutation(list(ALL_FILES))[:2]
    d.swap(str(one), str(other))(root)
    settle_hashes(root, rng)
    return f"{one}|{other}"


def _replace_by_something_else(root: Path, rng: Random) -> str:
    name = pick(rng, (*ALL_FILES, HASHES))
    path = root / name
    kind = pick(rng, ["fifo", "device", "device", "folder", "outside", "loop", "socket", "proc"])
    path.unlink()
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to(pick(rng, ["/dev/zero", "/dev/stdin", "/dev/full", "/dev/tty"]))
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
    name = pick(rng, ["data", "meta/episodes", "data/chunk-000"])
    shutil.rmtree(root / name)
    (root / name).symlink_to(pick(rng, ["/", "/proc", ".", "..", "/nonexistent"]))
    if rng.random() < 0.5:
        (root / HASHES).unlink()
    return "data|meta/episodes"


def _make_huge(root: Path, rng: Random) -> str:
    name = pick(rng, (*ALL_FILES, HASHES))
    os.truncate(root / name, SPARSE_BYTES if rng.random() < 0.5 else 200 << 20)
    if name != HASHES and rng.random() < 0.5:
        (root / HASHES).unlink()
    return name


def _pad_parquet(root: Path, rng: Random) -> str:
    """A footer that is found only behind a hole."""
    name = pick(rng, PARQUET_FILES)
    content = (root / name).read_bytes()
    footer = content[-int.from_bytes(content[-8:-4], "little") - 8 :]
    with (root / name).open("r+b") as file:
        file.seek(SPARSE_BYTES)
        file.write(footer)
    if rng.random() < 0.5:
        (root / HASHES).unlink()
    return name


def _add_a_file(root: Path, rng: Random) -> str:
    name = pick(
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


FILE_MUTATIONS: Final[tuple[Mutate, ...]] = (
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
)
