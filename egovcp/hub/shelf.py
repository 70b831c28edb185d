"""The files of one commit of a dataset, brought when they are needed, and kept."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, Self

from egovcp.errors import DataError, EgovcpError
from egovcp.hub.carrier import Errand, carrier
from egovcp.hub.failures import explained, token
from egovcp.hub.fetch import snapshot
from egovcp.hub.retry import RetryingClient, RetryPolicy, uses_default_client

#: Files that come at a time: one connection rarely fills a line to the Hub.
AHEAD: Final = 3


class Shelf:
    """A folder of the library's cache that fills as its files are asked for.

    What has been brought stays in the cache, where `snapshot` and LeRobot find it again; nothing
    is asked of the Hub for a file that is there.
    """

    def __init__(self, repo_id: str, folder: Path, cache_dir: Path, retry: RetryPolicy) -> None:
        """See `open`; the folder is named by the commit."""
        self.repo_id, self.folder, self.commit = repo_id, folder, folder.name
        self._cache_dir, self._retry = cache_dir, retry
        self._client = RetryingClient(retry)
        self._here: set[str] = set()
        self._locks: dict[str, threading.Lock] = {}
        self._coming: dict[str, threading.Thread] = {}

    @classmethod
    def open(
        cls,
        repo_id: str,
        revision: str,
        retry: RetryPolicy,
        cache_dir: Path,
        patterns: Sequence[str],
    ) -> Self:
        """The commit that a revision is now, with those of its files that match the patterns.

        If the Hub cannot be reached, the commit of an earlier download serves.

        Raises:
            DataError: there is no such dataset or revision.
            EnvironmentFailure: the Hub cannot be reached, or refuses.
        """
        folder = snapshot(repo_id, revision, retry, cache_dir=cache_dir, patterns=patterns)
        return cls(repo_id, folder, cache_dir, retry)

    def has(self, name: str) -> bool:
        """Whether a file has been brought."""
        if name not in self._here and (self.folder / name).exists():
            self._here.add(name)
        return name in self._here

    def bring(self, name: str) -> Path:
        """A file, which is waited for if it is not here yet.

        Raises:
            DataError: the commit has no such file.
            EnvironmentFailure: the Hub cannot be reached, or refuses; or the disk is full.
        """
        if not self.has(name):
            with self._locks.setdefault(name, threading.Lock()):
                self._fetch(name)
        return self.folder / name

    def expect(self, names: Iterable[str]) -> None:
        """Begin to bring the first of these files that are not here; `AHEAD` come at a time.

        What goes wrong with them is told to whoever needs the file.
        """
        for name in names:
            if len(self._coming) >= AHEAD:
                return
            if name not in self._coming and not self.has(name):
                thread = threading.Thread(target=self._try, args=(name,), daemon=True)
                self._coming[name] = thread
                thread.start()

    def _try(self, name: str) -> None:
        try:
            with (
                self._locks.setdefault(name, threading.Lock()),
                contextlib.suppress(EgovcpError, OSError),
            ):
                if not self._carried(name):
                    self._fetch(name)
        finally:
            del self._coming[name]

    def _carried(self, name: str) -> bool:
        """Whether the file is here, or came by a process that takes no time of this one's."""
        if self.has(name):
            return True
        if not uses_default_client():
            return False
        return carrier(self._retry.timeout_s).carry(self._errand(name)) and self.has(name)

    def _fetch(self, name: str) -> None:
        if self.has(name):  # whoever held the lock brought it
            return
        with explained(self.repo_id, self.commit), self._client.open():
            from huggingface_hub.errors import EntryNotFoundError

            try:
                self._errand(name).run()
            except EntryNotFoundError as error:
                raise DataError(
                    f"{self.repo_id}@{self.commit} has no {name}; the dataset on the Hub is "
                    "incomplete"
                ) from error

    def _errand(self, name: str) -> Errand:
        from huggingface_hub import constants

        cache_dir, endpoint = str(self._cache_dir), constants.ENDPOINT
        return Errand(self.repo_id, self.commit, name, cache_dir, endpoint, token())
