"""The files of one commit of a Hub dataset, downloaded when they are needed and kept on disk."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from egovcp.errors import DataError, EgovcpError
from egovcp.hub.errors import hub_token
from egovcp.hub.fetch import snapshot
from egovcp.hub.retry import RetryPolicy, call_hub

#: Files that are prefetched at a time: one connection rarely uses the whole bandwidth.
PREFETCH_FILES: Final = 3


class HubFileCache:
    """A snapshot folder of the library's cache that is filled file by file.

    Files stay in the cache, where `snapshot` and LeRobot find them. The Hub is not contacted for a
    file that is there.
    """

    def __init__(
        self,
        repo_id: str,
        revision: str,
        retry: RetryPolicy,
        cache_dir: Path,
        patterns: Sequence[str],
    ) -> None:
        """Resolve a revision to its commit and download those files that match ``patterns``.

        If the Hub cannot be reached, the commit of an earlier download is used.
        """
        self.repo_id = repo_id
        self.folder = snapshot(repo_id, revision, retry, cache_dir=cache_dir, patterns=patterns)
        self.commit = self.folder.name
        self._cache_dir, self._retry = cache_dir, retry
        self._present: set[str] = set()
        self._locks: dict[str, threading.Lock] = {}
        self._prefetching: dict[str, threading.Thread] = {}

    def has(self, name: str) -> bool:
        if name not in self._present and (self.folder / name).exists():
            self._present.add(name)
        return name in self._present

    def get(self, name: str) -> Path:
        if not self.has(name):
            with self._locks.setdefault(name, threading.Lock()):
                if not self.has(name):
                    self._download(name)
        return self.folder / name

    def prefetch(self, names: Iterable[str]) -> None:
        """Start to download the first missing files in threads, `PREFETCH_FILES` at a time.

        Errors are raised by `get`, which tries again.
        """
        for name in names:
            if len(self._prefetching) >= PREFETCH_FILES:
                return
            if name not in self._prefetching and not self.has(name):
                thread = threading.Thread(target=self._prefetch, args=(name,), daemon=True)
                self._prefetching[name] = thread
                thread.start()

    def _prefetch(self, name: str) -> None:
        try:
            with contextlib.suppress(EgovcpError, OSError):
                self.get(name)
        finally:
            del self._prefetching[name]

    def _download(self, name: str) -> None:
        from huggingface_hub import hf_hub_download
        from huggingface_hub.errors import EntryNotFoundError

        def download() -> None:
            try:
                hf_hub_download(
                    self.repo_id,
                    name,
                    repo_type="dataset",
                    revision=self.commit,
                    cache_dir=self._cache_dir,
                    token=hub_token() or False,
                    tqdm_class=_SilentBar,
                )
            except EntryNotFoundError as error:
                raise DataError(
                    f"{self.repo_id}@{self.commit} has no {name}; the dataset on the Hub is "
                    "incomplete"
                ) from error

        call_hub(download, self._retry, self.repo_id, self.commit)


class _SilentBar(tqdm):  # type: ignore[misc]
    """A progress bar that is not shown, because it would interrupt that of the training."""

    def __init__(self, *args: Any, **options: Any) -> None:
        options.pop("name", None)  # an argument of Hugging Face's own bars
        super().__init__(*args, **options | {"disable": True})
