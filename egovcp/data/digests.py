"""Digests of episodes, compared in a thread while the next ones are read.

To hash an episode takes a third as long as to decode it, and leaves the interpreter to others.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

from egovcp.data.episode import Episode
from egovcp.errors import DataError


class Digests:
    """Those of the episodes of one block; see `comparing`."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        """Nothing is hashed yet."""
        self._pool = pool
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

    def settle(self) -> None:
        """Wait, and raise `DataError` for the first episode that differs."""
        for found, digest, otherwise in self._pending:
            if found.result() != digest:
                raise otherwise


@contextmanager
def comparing() -> Iterator[Digests]:
    """Compare episodes while others are read; what is wrong is raised when the block ends.

    Raises:
        DataError: an episode differs from what was recorded; unless the block raises itself.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="digests") as pool:
        digests = Digests(pool)
        yield digests
        digests.settle()
