"""Episode records (``meta/collection.json``) of several datasets by digest; joint provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, Provenance, metadata, schema
from egovcp.data.metadata import record_problems
from egovcp.data.provenance import (
    SOURCE,
    SOURCES,
    parse_provenance,
    source_index,
    source_provenances,
)
from egovcp.errors import DataError

type Record = Mapping[str, Any]


def require_one_controller(controllers: Mapping[Path, str]) -> None:
    """Raise `DataError` unless the datasets were collected with the same low-level controller."""
    (first, expected), *others = controllers.items()
    for root, controller in others:
        if controller != expected:
            raise DataError(
                f"{root} was collected with low-level controller {controller}, {first} with "
                f"{expected}; the same action has different effects, so they cannot be joined"
            )


def join_provenance(provenances: Sequence[Provenance], command: str) -> Provenance:
    """The provenance of a dataset that joins others.

    It is the first one if all are equal but for the command. Otherwise it lists all of them as
    sources; `join_metadata` then gives each episode the index of its source.
    """
    first = provenances[0]
    if _all_equal(provenances):
        return first
    parts = [part for provenance in provenances for part in source_provenances(provenance)]
    common = set.intersection(*(set(provenance.versions.items()) for provenance in provenances))
    return Provenance(
        controller_id=first.controller_id,
        seed=None,
        command=command,
        versions={name: v for name, v in first.versions.items() if (name, v) in common},
        config={SOURCES: [asdict(part) for part in parts]},
    )


def join_metadata(episode: Record, provenances: Sequence[Provenance], index: int) -> dict[str, Any]:
    """An episode's ``metadata`` under `join_provenance`; its own provenance has this index."""
    if _all_equal(provenances):
        return dict(episode)
    before = sum(len(source_provenances(provenance)) for provenance in provenances[:index])
    return {
        **episode,
        SOURCE: before + source_index(len(source_provenances(provenances[index])), episode),
    }


def _all_equal(provenances: Sequence[Provenance]) -> bool:
    """Whether the provenances differ at most in the command, on which no episode depends."""
    first, *others = (replace(provenance, command="") for provenance in provenances)
    return all(other == first for other in others)


@dataclass(frozen=True)
class RecordIndex:
    """The records of a dataset and of those that its episodes were taken from."""

    provenance: Provenance
    by_digest: Mapping[str, Record]
    """`Episode.digest` -> record, of all datasets."""
    by_index: Mapping[int, Record]
    """Index of the episode -> record, of the records without a digest (collection version 1)."""
    recorded: int
    """Episodes that the dataset itself recorded."""

    @classmethod
    def build(cls, root: Path, originals: Sequence[Path], command: str) -> RecordIndex:
        """Read the records of the dataset at ``root`` and of the originals.

        Raises:
            DataError: there are no records, an original is damaged, or controllers differ.
        """
        own = _read_damaged(root, required=not originals)
        datasets = [*([own] if own else []), *(_read_original(path) for path in originals)]
        require_one_controller({path: origin.controller_id for path, origin, _ in datasets})
        provenances = [provenance for _, provenance, _ in datasets]
        by_digest: dict[str, Record] = {}
        by_index: dict[int, Record] = {}
        for source, (_, _, records) in enumerate(datasets):
            for index, record in enumerate(records):
                if record:
                    joined = join_metadata(record.get("metadata", {}), provenances, source)
                    found = {**record, "metadata": joined}
                    if digest := record.get("sha256"):
                        by_digest.setdefault(digest, found)
                    else:
                        by_index.setdefault(index, found)
        provenance = join_provenance(provenances, command)
        return cls(provenance, by_digest, by_index, len(own[2]) if own else 0)

    def find(self, digest: str, index: int) -> Record | None:
        """The record of the episode with this digest, or with this index; None if there is none."""
        return self.by_digest.get(digest) or self.by_index.get(index)


type _Dataset = tuple[Path, Provenance, Sequence[Record]]


def _read_damaged(root: Path, required: bool) -> _Dataset | None:
    """The valid records of the dataset to repair, an empty one for each invalid one.

    Without readable records it raises `DataError` if they are ``required``, else returns None.
    """
    path = root / schema.COLLECTION_PATH
    try:
        content = metadata.load_json_object(path, root)
        found = content.get("spec_version")
        if found != spec.SPEC_VERSION:
            raise DataError.at(path, f"specification {found}, expected {spec.SPEC_VERSION}")
        provenance = parse_provenance(content, path)
    except DataError as error:
        if not required:
            return None
        raise DataError(
            f"{error}; give the dataset that the episodes were taken from: --records=ORIGINAL"
        ) from error
    records = content.get("episodes")
    records = records if isinstance(records, list) else []
    valid = [isinstance(r, dict) and not list(record_problems(r)) for r in records]
    return root, provenance, [r if ok else {} for r, ok in zip(records, valid, strict=True)]


def _read_original(root: Path) -> _Dataset:
    """The records of a valid dataset; missing digests are computed."""
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
    return reader.root, reader.origin, records
