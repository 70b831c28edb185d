"""The next batch made in a thread while the last one is being trained on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol, Self

from egovcp.data.windows import Batch

type Made = tuple[Batch, dict[str, Any]]


class Resumable(Protocol):
    """A stream of batches that says where it stands."""

    def __next__(self) -> Batch: ...
    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: Mapping[str, Any]) -> object: ...


class Ahead:
    """The same batches as those of ``stream``, which nobody else may use.

    Its state is that after the last batch that was taken, not after the last one that was made.
    """

    def __init__(self, stream: Resumable) -> None:
        """Nothing is made before the first batch is asked for."""
        self._stream = stream
        self._state = stream.state_dict()
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="batches")
        self._pending: Future[Made] | None = None

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """The next batch; raises what the stream raised when it made it."""
        pending = self._pending or self._worker.submit(self._make)
        batch, self._state = pending.result()
        self._pending = self._worker.submit(self._make)
        return batch

    def state_dict(self) -> dict[str, Any]:
        """State of the stream after the last batch taken."""
        return self._state

    def load_state_dict(self, state: Mapping[str, Any]) -> Self:
        """Continue where another stream stopped; what was made ahead is dropped."""
        if self._pending is not None:
            self._pending.exception()  # waits; an error belongs to a batch that nobody wants
            self._pending = None
        self._stream.load_state_dict(state)
        self._state = self._stream.state_dict()
        return self

    def _make(self) -> Made:
        return next(self._stream), self._stream.state_dict()
