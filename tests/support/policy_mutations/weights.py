"""Mutations of the weights, whose digests are renewed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import numpy as np
import torch

from egovcp.artifact import FILES, WEIGHTS
from tests.support.file_mutations import Random, flip_bits, pick
from tests.support.policy_mutations.editing import (
    ANY_FILE,
    Json,
    Mutate,
    edit_header,
    edit_tensors,
    pickled,
    renew_digests,
)


def _flip_bits_of_a_file(folder: Path, rng: Random) -> str:
    name = pick(rng, FILES)
    flip_bits(folder / name, rng, 7)
    return str(name)


def _flip_bits_of_the_header(folder: Path, rng: Random) -> str:
    content = bytearray((folder / WEIGHTS).read_bytes())
    size = int.from_bytes(content[:8], "little")
    for at in rng.integers(8 + size, size=int(rng.integers(1, 4))):
        content[at] ^= 1 << int(rng.integers(8))
    (folder / WEIGHTS).write_bytes(content)
    renew_digests(folder)
    return ANY_FILE


def _flip_bits_of_the_tensors(folder: Path, rng: Random) -> str:
    content = bytearray((folder / WEIGHTS).read_bytes())
    start = 8 + int.from_bytes(content[:8], "little")
    for at in rng.integers(start, len(content), size=int(rng.integers(1, 64))):
        content[at] ^= 1 << int(rng.integers(8))
    (folder / WEIGHTS).write_bytes(content)
    renew_digests(folder)
    return ANY_FILE


def _truncate_weights(folder: Path, rng: Random) -> str:
    size = (folder / WEIGHTS).stat().st_size
    os.truncate(folder / WEIGHTS, int(rng.integers(size)))
    renew_digests(folder)
    return WEIGHTS


def _append_to_weights(folder: Path, rng: Random) -> str:
    with (folder / WEIGHTS).open("ab") as file:
        file.write(rng.bytes(int(rng.integers(1, 4096))))
    renew_digests(folder)
    return WEIGHTS


def _swap_tensors(folder: Path, rng: Random) -> str:
    def swap(tensors: dict[str, torch.Tensor]) -> None:
        one = pick(rng, list(tensors))
        others = [k for k, v in tensors.items() if v.shape != tensors[one].shape]
        other = pick(rng, others)
        tensors[one], tensors[other] = tensors[other], tensors[one]

    return edit_tensors(folder, swap)


def _rename_a_tensor(folder: Path, rng: Random) -> str:
    def rename(tensors: dict[str, torch.Tensor]) -> None:
        old = pick(rng, list(tensors))
        tensors[pick(rng, [old.upper(), f"model.{old}", "", "\x1b[31m", "../" + old])] = (
            tensors.pop(old)
        )

    return edit_tensors(folder, rename)


def _drop_or_add_a_tensor(folder: Path, rng: Random) -> str:
    def change(tensors: dict[str, torch.Tensor]) -> None:
        if rng.random() < 0.5:
            del tensors[pick(rng, list(tensors))]
        else:
            tensors["extra"] = torch.zeros(int(rng.integers(100)))

    return edit_tensors(folder, change)


def _reshape_a_tensor(folder: Path, rng: Random) -> str:
    def reshape(tensors: dict[str, torch.Tensor]) -> None:
        matrices = [k for k, v in tensors.items() if v.ndim == 2]
        name = pick(rng, [k for k in matrices if len({1, *tensors[k].shape}) == 3])
        flat = tensors[name].flatten()
        shapes = (flat, flat[None], tensors[name].T.contiguous(), tensors[name][:0])
        tensors[name] = pick(rng, shapes)

    return edit_tensors(folder, reshape)


def _put_in_numbers_that_are_not_finite(folder: Path, rng: Random) -> str:
    def spoil(tensors: dict[str, torch.Tensor]) -> None:
        flat = tensors[pick(rng, list(tensors))].view(-1)
        flat[int(rng.integers(len(flat)))] = pick(rng, [np.nan, np.inf, -np.inf])

    return edit_tensors(folder, spoil)


def _scale_weights_until_they_overflow(folder: Path, rng: Random) -> str:
    def scale(tensors: dict[str, torch.Tensor]) -> None:
        for tensor in tensors.values():
            tensor[...] = pick(rng, [3e38, 2e38])

    return edit_tensors(folder, scale)


def _make_a_scale_useless(folder: Path, rng: Random) -> str:
    def change(tensors: dict[str, torch.Tensor]) -> None:
        name = pick(rng, ["state_std", "return_std", "discount"])
        flat = tensors[name].view(-1)
        wrong = [-1.0, 2.0] if name == "discount" else [0.0, -1.0]
        flat[int(rng.integers(len(flat)))] = pick(rng, wrong)

    return edit_tensors(folder, change)


def _change_a_dtype(folder: Path, rng: Random) -> str:
    kinds = [torch.int8, torch.int32, torch.int64, torch.bool, torch.uint8, torch.float64]
    kinds += [torch.float8_e4m3fn]

    def change(tensors: dict[str, torch.Tensor]) -> None:
        names = list(tensors)
        kind = pick(rng, kinds)
        for name in names if rng.random() < 0.5 else [pick(rng, names)]:
            tensors[name] = tensors[name].to(kind)

    return edit_tensors(folder, change)


def _claim_a_dtype(folder: Path, rng: Random) -> str:
    def change(header: Json) -> None:
        name = pick(rng, [k for k in header if k != "__metadata__"])
        header[name]["dtype"] = pick(rng, ["I32", "U32", "f32", "F33", "", None, 32, "I8"])

    return edit_header(folder, change)


def _claim_a_shape(folder: Path, rng: Random) -> str:
    def change(header: Json) -> None:
        entry = header[pick(rng, [k for k in header if k != "__metadata__"])]
        absurd = [[-1], [2**62], [2**40, 2**40], [1.5], ["2"], None, 3, [1] * 10_000]
        entry["shape"] = pick(rng, absurd)

    return edit_header(folder, change)


def _claim_offsets(folder: Path, rng: Random) -> str:
    def change(header: Json) -> None:
        names = [k for k in header if k != "__metadata__"]
        entry, other = header[pick(rng, names[:3])], header[pick(rng, names[3:])]
        absurd = [[0, 2**62], [-8, 0], [8, 0], [0], None, "0", other["data_offsets"]]
        entry["data_offsets"] = pick(rng, absurd)

    return edit_header(folder, change)


def _claim_a_header_size(folder: Path, rng: Random) -> str:
    content = bytearray((folder / WEIGHTS).read_bytes())
    size = pick(rng, [0, 1, 2**63, 2**64 - 1, len(content), 100 << 20])
    content[:8] = int(size).to_bytes(8, "little")
    (folder / WEIGHTS).write_bytes(content)
    renew_digests(folder)
    return WEIGHTS


def _nest_the_header(folder: Path, rng: Random) -> str:
    depth = int(rng.integers(10_000, 200_000))
    text = b'{"a":' + b"[" * depth + b"]" * depth + b"}"
    (folder / WEIGHTS).write_bytes(len(text).to_bytes(8, "little") + text)
    renew_digests(folder)
    return WEIGHTS


def _replace_weights_by_a_pickle(folder: Path, rng: Random) -> str:
    (folder / WEIGHTS).write_bytes(pickled(folder, rng))
    renew_digests(folder)
    return WEIGHTS


def _make_weights_huge(folder: Path, rng: Random) -> str:
    os.truncate(folder / WEIGHTS, int(rng.integers(4, 4000)) << 30)  # sparse
    return WEIGHTS


WEIGHT_MUTATIONS: Final[tuple[Mutate, ...]] = (
    _flip_bits_of_a_file,
    _flip_bits_of_the_header,
    _flip_bits_of_the_tensors,
    _truncate_weights,
    _append_to_weights,
    _swap_tensors,
    _rename_a_tensor,
    _drop_or_add_a_tensor,
    _reshape_a_tensor,
    _put_in_numbers_that_are_not_finite,
    _scale_weights_until_they_overflow,
    _make_a_scale_useless,
    _change_a_dtype,
    _claim_a_dtype,
    _claim_a_shape,
    _claim_offsets,
    _claim_a_header_size,
    _nest_the_header,
    _replace_weights_by_a_pickle,
    _make_weights_huge,
)
