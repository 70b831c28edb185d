"""Digests of episodes, compared in a thread while the next ones are read.

To hash an episode takes a third as long as to decode it, and leaves the interpreter to others.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self

from egovcp.data.episode import Episode
from egovcp.errors import DataError


class Digests:
    """Compares what it is given until its block ends, and raises there what is wrong.

    As a context manager::

        with Digests() as digests:
            episodes = [reader.read(index, digests) for index in range(8)]
    """

    def __init__(self) -> None:
        """No thread is started before there is an episode."""
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="digests")
        self._pending: list[tuple[Future[str], str, DataError]] = []

    def compare(self, episode: Episode, digest: str, otherwise: DataError) -> None:
        """Have an episode compared with its recorded digest, unless that is empty.

        Args:
            episode: must not change before the block ends.
            digest: what `Episode.digest` should be.
            otherwise: raised at the end of the block if it is something else.
        """
        if digest:
            self._pending.append((self._pool.submit(episode.digest), digest, otherwise))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Raise `DataError` for the first episode that differs, unless something else is raised."""
        self._pool.shutdown()
        if kind is None:
            for found, digest, otherwise in self._pending:
                if found.result() != digest:
                    raise otherwise
