"""Checks that no episode of a dataset occurs twice."""

from __future__ import annotations

from collections.abc import Iterator

from egovcp.data import DatasetReader, schema
from egovcp.data.provenance import DuplicateFinder
from egovcp.errors import DataError


class DuplicateEpisodes:
    """Finds the episodes of a dataset that occur twice."""

    def __init__(self, reader: DatasetReader) -> None:
        self._reader = reader
        self._finder = DuplicateFinder[int]()

    def problems(self, index: int, digest: str) -> Iterator[DataError]:
        """The problem of an episode that repeats an earlier one."""
        reader = self._reader
        try:
            scenario = reader.scenario(index)
        except DataError as error:
            yield error
            return
        found = self._finder.add(index, digest, scenario)
        if found is not None:
            record = reader.root / schema.COLLECTION_PATH
            path = reader.data_path(index) if found.equal else record
            yield DataError.at(path, found.problem(scenario), index)
