"""Seeded mutations of files, of policies and of datasets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

type Random = np.random.Generator
type ChangeText = Callable[[str, Random], str | bytes]


def pick[T](rng: Random, choices: Sequence[T]) -> T:
    """One of them."""
    return choices[int(rng.integers(len(choices)))]


def flip_bits(path: Path, rng: Random, most: int) -> None:
    """Flip up to ``most`` bits of a file."""
    content = bytearray(path.read_bytes())
    for at in rng.integers(len(content), size=int(rng.integers(1, most + 1))):
        content[at] ^= 1 << int(rng.integers(8))
    path.write_bytes(content)


def json_mutations(
    files: Sequence[str], write: Callable[[Path, str, str | bytes, Random], object]
) -> tuple[Callable[[Path, Random], str], ...]:
    """Mutations of a folder, each of which damages one of its JSON ``files`` and returns its name.

    ``write(folder, name, content, rng)`` replaces the content of a file and renews digests.
    """

    def mutation(change: ChangeText) -> Callable[[Path, Random], str]:
        def mutate(folder: Path, rng: Random) -> str:
            name = pick(rng, files)
            write(folder, name, change((folder / name).read_text(), rng), rng)
            return name

        mutate.__name__ = change.__name__
        return mutate

    return tuple(map(mutation, _JSON_CHANGES))


def _add_entry(text: str, value: str) -> str:
    return text.replace("{", f'{{"extra": {value},', 1)


def _write_a_constant_that_is_no_json(text: str, rng: Random) -> str:
    constants = ["NaN", "Infinity", "-Infinity", "1e999", "-1e400", "1" * 5000]
    return _add_entry(text, pick(rng, constants))


def _nest_json(text: str, rng: Random) -> str:
    depth = int(rng.integers(1000, 1_000_000))
    opening, closing = pick(rng, [("[", "]"), ('{"a":', "}")])
    return _add_entry(text, opening * depth + "1" + closing * depth)


def _write_many_values(text: str, rng: Random) -> str:
    return _add_entry(text, "[" + ",".join(["[]"] * 1_500_000) + "]")


def _write_json_in_another_encoding(text: str, rng: Random) -> bytes:
    """JSON that is not UTF-8, or not JSON at all."""
    encodings = [
        text.encode("utf-16"),
        text.encode().replace(b"e", b"\xff", 1),
        text.replace("{", '{"\\ud800": 1,', 1).encode(),
        text.encode() + b"\0",
        b"",
    ]
    return pick(rng, encodings)


def _write_something_else_than_an_object(text: str, rng: Random) -> str:
    return pick(rng, ["[]", "3", "null", '"text"', "true", "{}", "[{}]"])


_JSON_CHANGES: tuple[ChangeText, ...] = (
    _write_a_constant_that_is_no_json,
    _nest_json,
    _write_many_values,
    _write_json_in_another_encoding,
    _write_something_else_than_an_object,
)
