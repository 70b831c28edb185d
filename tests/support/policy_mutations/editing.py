"""What mutations of a policy have in common: they edit a file, then renew the digests of it."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import torch
from safetensors.torch import load, save

from egovcp.artifact import CONFIG, WEIGHTS
from egovcp.manifest import MANIFEST, PROCESSORS, sealed
from tests.support.file_mutations import Random

type Json = dict[str, Any]
type Mutate = Callable[[Path, Random], str | None]
"""Changes a policy folder; returns the files, separated by ``|``, one of which must be named, or
None if the policy must still load."""

MARKER: Final = "EXECUTED"
"""A file of this name appears in the policy folder if code of the policy is executed."""
ANY_FILE: Final = "*"
"""Returned by a `Mutate` whose policy may load, with the tensors of its file, or be refused."""
JSON_FILES: Final = (CONFIG, MANIFEST, *PROCESSORS)


def renew_digests(folder: Path) -> None:
    """Make the manifest agree with the files as they are now."""
    manifest = json.loads((folder / MANIFEST).read_text())
    for name in manifest["files"]:
        manifest["files"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(sealed(manifest)))


def edit_json(folder: Path, name: str, change: Callable[[Json], object]) -> str:
    content = json.loads((folder / name).read_text())
    change(content)
    write_json(folder, name, json.dumps(sealed(content) if name == MANIFEST else content))
    return name


def write_json(folder: Path, name: str, text: str | bytes) -> None:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    if name != MANIFEST:
        renew_digests(folder)


def edit_tensors(folder: Path, change: Callable[[dict[str, torch.Tensor]], object]) -> str:
    tensors = dict(sorted(load((folder / WEIGHTS).read_bytes()).items()))  # in a fixed order
    change(tensors)
    (folder / WEIGHTS).write_bytes(save(tensors))
    renew_digests(folder)
    return WEIGHTS


def edit_header(folder: Path, change: Callable[[Json], object]) -> str:
    """Change what the header of the weights says, not the bytes that follow it."""
    content = (folder / WEIGHTS).read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
    change(header)
    text = json.dumps(header).encode()
    (folder / WEIGHTS).write_bytes(len(text).to_bytes(8, "little") + text + content[start:])
    renew_digests(folder)
    return WEIGHTS


class _Payload:
    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str, str]]:
        return (open, (self.path, "w"))


def pickled(folder: Path, rng: Random) -> bytes:
    payload = _Payload(str(folder / MARKER))
    if rng.random() < 0.5:
        return pickle.dumps(payload)
    buffer = io.BytesIO()
    torch.save(payload, buffer)
    return buffer.getvalue()
