"""Is every episode of a dataset in it once?"""

from __future__ import annotations

from collections.abc import Iterator

from egovcp.data import DatasetReader, schema
from egovcp.data.duplicates import DuplicateFinder
from egovcp.errors import DataError


class DuplicateEpisodes:
    """Finds episodes of a dataset that are in it twice."""

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
        if found is not None and found.equal:
            yield DataError.at(reader.data_path(index), f"repeats episode {found.place}", index)
        elif found is not None:
            problem = f"is {scenario}, and so is episode {found.place}, of other content"
            yield DataError.at(reader.root / schema.COLLECTION_PATH, problem, index)
