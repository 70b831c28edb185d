"""A progress bar of checked episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm


@contextmanager
def progress_bar(title: str = "") -> Iterator[Callable[[int, int], None]]:
    """A progress bar, as a function of the episodes done and their total."""
    with tqdm(desc=title or None, unit="ep", delay=1) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show
