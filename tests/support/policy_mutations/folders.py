"""Mutations of the manifest and of the folder, and changes that do no harm."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from safetensors.torch import load, save

from egovcp.artifact import CONFIG, FILES, WEIGHTS
from egovcp.manifest import MANIFEST, PROCESSORS, SEAL
from tests.support.file_mutations import Random, pick
from tests.support.policy_mutations.editing import (
    MARKER,
    Json,
    Mutate,
    edit_json,
    pickled,
    renew_digests,
    write_json,
)


def _give_an_entry_another_type(folder: Path, rng: Random) -> str:
    names = ["controller_id", "files", "schema_version", "features", "step", "tasks", "command"]
    names += ["versions", "datasets", "heldout", "train_config", "egovcp_version"]

    def change(content: Json) -> None:
        name = pick(rng, names)
        wrong: list[Any] = [True, 1.5, [[1]], {"a": {"b": [1]}}, [{"repo_id": 3}]]
        wrong = [v for v in wrong if name != "train_config" or not isinstance(v, dict)]
        content[name] = pick(rng, wrong)

    return edit_json(folder, MANIFEST, change)


def _change_the_features(folder: Path, rng: Random) -> str:
    def change(content: Json) -> None:
        features = content["features"]
        match int(rng.integers(4)):
            case 0:
                features[pick(rng, list(features))] = pick(rng, [None, 1.5, [], "x"])
            case 1:
                features["action_box"]["low"][0] = pick(rng, [-1e9, 0, None])
            case 2:
                features["state_names"].reverse()
            case 3:
                features["extra"] = 1

    return edit_json(folder, MANIFEST, change)


def _change_a_digest(folder: Path, rng: Random) -> str:
    name = str(pick(rng, [CONFIG, WEIGHTS, *PROCESSORS]))
    digests: list[Any] = ["0" * 64, "", "\x1b]0;title\x07" * 1000]

    def change(content: Json) -> None:
        content["files"][name] = pick(rng, digests)

    edit_json(folder, MANIFEST, change)
    return name


def _break_the_seal(folder: Path, rng: Random) -> str:
    content = json.loads((folder / MANIFEST).read_text())
    content[SEAL] = pick(rng, ["0" * 64, None, 3, [], {}])
    (folder / MANIFEST).write_text(json.dumps(content))
    return MANIFEST


def _replace_a_file_by_something_else(folder: Path, rng: Random) -> str:
    name = str(pick(rng, FILES))
    path = folder / name
    path.unlink()
    match int(rng.integers(6)):
        case 0:
            os.mkfifo(path)
        case 1:
            path.mkdir()
        case 2:
            path.symlink_to(pick(rng, ["/dev/zero", "/dev/random", "/dev/full", "/dev/tty"]))
        case 3:
            path.symlink_to(pick(rng, [path.name, "absent", "."]))
        case 4:
            os.mkfifo(folder / "fifo")
            path.symlink_to("fifo")
        case 5:
            with socket.socket(socket.AF_UNIX) as listener:
                here = os.open(folder, os.O_RDONLY)  # the path of a socket must be short
                listener.bind(f"/proc/self/fd/{here}/{name}")
                os.close(here)
    return name


def _remove_a_file(folder: Path, rng: Random) -> str:
    name = str(pick(rng, FILES))
    (folder / name).unlink()
    return name


def _add_files(folder: Path, rng: Random) -> None:
    for name in ("pytorch_model.bin", "model.pkl", "training_state.pt", "optimizer.json"):
        (folder / name).write_bytes(pickled(folder, rng))
    for name in ("modeling_egovcp.py", "torch.py", "conftest.py", "__init__.py"):
        (folder / name).write_text(f"open({str(folder / MARKER)!r}, 'w')\n")
    os.mkfifo(folder / "extra.safetensors")
    (folder / "zero.json").symlink_to("/dev/zero")


def _write_json_in_another_layout(folder: Path, rng: Random) -> None:
    for name in (CONFIG, *PROCESSORS, MANIFEST):
        content = json.loads((folder / name).read_text())
        keys = [str(key) for key in rng.permutation(list(content))]
        text = json.dumps({key: content[key] for key in keys}, indent=int(rng.integers(5)))
        write_json(folder, name, text)


def _link_to_the_files(folder: Path, rng: Random) -> None:
    (folder / "blobs").mkdir()
    for number, name in enumerate(FILES):
        (folder / name).rename(folder / "blobs" / str(number))
        (folder / name).symlink_to(f"blobs/{number}")


def _reorder_tensors(folder: Path, rng: Random) -> None:
    tensors = load((folder / WEIGHTS).read_bytes())
    names = [str(name) for name in rng.permutation(sorted(tensors))]
    content = {name: tensors[name] for name in names}
    (folder / WEIGHTS).write_bytes(save(content, {"format": "pt", "note": "reordered"}))
    renew_digests(folder)


def _halve_the_precision(folder: Path, rng: Random) -> None:
    tensors = load((folder / WEIGHTS).read_bytes())
    kind = pick(rng, [torch.float16, torch.bfloat16])
    (folder / WEIGHTS).write_bytes(save({k: v.to(kind) for k, v in tensors.items()}))
    renew_digests(folder)


def _add_entries_to_the_manifest(folder: Path, rng: Random) -> None:
    extra: Mapping[str, Any] = {"note": "x" * 1000, "list": [1, None, {"a": []}]}

    def change(content: Json) -> None:
        content.update(extra)
        content["files"]["../../../etc/passwd"] = "0" * 64

    edit_json(folder, MANIFEST, change)


FOLDER_MUTATIONS: Final[tuple[Mutate, ...]] = (
    _give_an_entry_another_type,
    _change_the_features,
    _change_a_digest,
    _break_the_seal,
    _replace_a_file_by_something_else,
    _remove_a_file,
    _add_files,
    _write_json_in_another_layout,
    _link_to_the_files,
    _reorder_tensors,
    _halve_the_precision,
    _add_entries_to_the_manifest,
)
