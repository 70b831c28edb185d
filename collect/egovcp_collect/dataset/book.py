"""The records of ``meta/collection.json`` of one or several datasets, found by digest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, Provenance, metadata, schema
from egovcp.data.metadata import record_problems
from egovcp.data.provenance import parse_provenance
from egovcp.errors import DataError
from egovcp_collect.dataset.origin import joint, moved, require_one_controller


@dataclass(frozen=True)
class Volume:
    """The records of one dataset."""

    root: Path
    origin: Provenance
    records: Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Book:
    """Records of all volumes by `Episode.digest`; those of the dataset itself by number as well."""

    provenance: Provenance
    by_digest: Mapping[str, Mapping[str, Any]]
    by_number: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    """Records of the dataset's own that hold no digest (collection version 1)."""
    own: int = 0
    """Episodes that the dataset itself recorded."""

    def find(self, digest: str, number: int) -> Mapping[str, Any] | None:
        """The record of an episode, None if there is none."""
        return self.by_digest.get(digest) or self.by_number.get(number)


def open_book(root: Path, originals: Sequence[Path], command: str) -> Book:
    """The records of the dataset at ``root`` and of the originals.

    Raises:
        DataError: there are none at all, an original is damaged, or controllers differ.
    """
    own = _own_volume(root, required=not originals)
    volumes = [*([own] if own else []), *(_original_volume(path) for path in originals)]
    require_one_controller({volume.root: volume.origin.controller_id for volume in volumes})
    origins = [volume.origin for volume in volumes]
    by_digest: dict[str, Mapping[str, Any]] = {}
    by_number: dict[int, Mapping[str, Any]] = {}
    for index, volume in enumerate(volumes):
        for number, record in enumerate(volume.records):
            facts = moved(record.get("metadata", {}), origins, index)
            if record.get("sha256"):
                by_digest.setdefault(record["sha256"], {**record, "metadata": facts})
            elif record:
                by_number[number] = {**record, "metadata": facts}
    return Book(joint(origins, command), by_digest, by_number, len(own.records) if own else 0)


def _own_volume(root: Path, required: bool) -> Volume | None:
    """The records of the dataset to repair, as far as they are sound; None without any."""
    path = root / schema.COLLECTION_PATH
    try:
        content = metadata.load_json_object(path, root)
        origin = _origin(content, path)
    except DataError as error:
        if not required:
            return None
        raise DataError(
            f"{error}; give the dataset that the episodes were taken from: --records=ORIGINAL"
        ) from error
    records = content.get("episodes")
    sound = [_sound(record) for record in records] if isinstance(records, list) else []
    return Volume(root, origin, sound)


def _origin(content: dict[str, Any], path: Path) -> Provenance:
    if content.get("spec_version") != spec.SPEC_VERSION:
        found = content.get("spec_version")
        raise DataError.at(path, f"specification {found}, expected {spec.SPEC_VERSION}")
    return parse_provenance(content, path)


def _sound(record: object) -> Mapping[str, Any]:
    """The record, or an empty one in place of a damaged one, so that numbers stay."""
    usable = isinstance(record, dict) and not list(record_problems(record))
    return record if usable and isinstance(record, dict) else {}


def _original_volume(root: Path) -> Volume:
    """The records of a sound dataset; a digest that it does not hold is made from the episode."""
    reader = DatasetReader.open(DatasetConfig(root=str(root)))
    records = [
        {
            "task": reader.task(i),
            "time_limit": reader.time_limit(i),
            "sha256": reader.digest(i) or reader.read(i).digest(),
            "metadata": reader.metadata(i),
        }
        for i in range(len(reader))
    ]
    return Volume(reader.root, reader.origin, records)
