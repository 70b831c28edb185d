"""Datasets as earlier versions of egovcp wrote them."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq

from egovcp import spec


def without_optional_columns(root: Path) -> None:
    """Remove the columns of ``spec.OPTIONAL_KEYS``, and the recorded hashes, from a dataset."""
    for path in (root / "data").rglob("*.parquet"):
        pq.write_table(pq.read_table(path).drop_columns([*spec.OPTIONAL_KEYS]), path)
    info = json.loads((root / "meta/info.json").read_text())
    for key in spec.OPTIONAL_KEYS:
        del info["features"][key]
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / "meta/sha256.json").unlink()
