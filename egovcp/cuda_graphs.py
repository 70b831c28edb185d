"""CUDA graphs: the many small kernels of a plan, or of a gradient step, recorded once per shape and
replayed as one.

A recording reads and writes memory of its own: inputs are copied into it. What cannot be recorded
is computed as before, and is not tried again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

MOST_RECORDINGS: Final = 8
"""By default: searches have few shapes, and further ones are computed as before."""
WARM_UP: Final = 3
"""Calls before a recording: libraries choose their kernels, constants are made and kept."""

type Replay = Callable[[], object]
type Record = Callable[[Callable[[], Any], torch.device], tuple[Replay, Any]]
"""Makes of a function without arguments, which works on a device, its replay, and what that writes
its results to."""


class Recorder:
    """Makes CUDA graphs, none of which may be replayed while another is: they share the memory of
    what is no result."""

    def __init__(self) -> None:
        self._pools: dict[torch.device, Any] = {}

    def __call__(self, function: Callable[[], Any], device: torch.device) -> tuple[Replay, Any]:
        """See `Record`.

        Raises:
            RuntimeError: something in it cannot be recorded, such as a copy from the processor.
        """
        # Whose streams are meant: a recording of another's is empty.
        with torch.cuda.device(device):
            if device not in self._pools:
                self._pools[device] = torch.cuda.graph_pool_handle()
            return _record(function, self._pools[device])


def _record(function: Callable[[], Any], pool: Any) -> tuple[Replay, Any]:
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_UP):
            function()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, pool, capture_error_mode="thread_local"):  # others go on meanwhile
        results = function()
    return graph.replay, results


class _Recording(NamedTuple):
    inputs: list[Tensor]  # that the replay reads
    replay: Replay
    results: Any  # that it writes


class Recorded:
    """A function of tensors, in tuples or None as well, that does the same to equal shapes; what is
    no tensor is part of the shape.

    Args:
        function: waits for nothing, draws nothing, and has no effect but its results.
        how: makes a recording; a `RuntimeError` says that there can be none. None: a `Recorder`.
        most: recordings.
        copies: of the results, so that no later call changes them.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        how: Record | None = None,
        most: int = MOST_RECORDINGS,
        copies: bool = True,
    ) -> None:
        self._function, self._how = function, how or Recorder()
        self._most, self._copies = most, copies
        self._recordings: dict[object, _Recording | None] = {}
        self.refused = ""
        """Why something could not be recorded; empty: nothing was tried in vain."""

    def __call__(self, *arguments: Any) -> Any:
        """The function's results."""
        key = _shape(arguments)
        if key not in self._recordings:
            full = len(self._recordings) >= self._most
            self._recordings[key] = None if full else self._record(arguments)
        recording = self._recordings[key]
        if recording is None:
            return self._function(*arguments)
        for buffer, given in zip(recording.inputs, _tensors(arguments), strict=True):
            buffer.copy_(given)
        recording.replay()
        return _map(recording.results, Tensor.clone) if self._copies else recording.results

    @property
    def shapes(self) -> int:
        """How many are replayed."""
        return sum(recording is not None for recording in self._recordings.values())

    @torch.inference_mode(False)  # buffers are written to under either mode
    @torch.no_grad()
    def _record(self, arguments: tuple[Any, ...]) -> _Recording | None:
        own = _map(arguments, lambda x: x.detach().clone(memory_format=torch.contiguous_format))
        try:
            device = next(_tensors(own)).device
            replay, results = self._how(lambda: self._function(*own), device)
        except RuntimeError as error:
            self.refused = " ".join(str(error).split())[:200]
            return None
        return _Recording(list(_tensors(own)), replay, results)


def _tensors(tree: Any) -> Iterator[Tensor]:
    """In the order of the tuples they are in."""
    if isinstance(tree, Tensor):
        yield tree
    elif isinstance(tree, tuple):
        for part in tree:
            yield from _tensors(part)


def _map(tree: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """The same tuples of other tensors."""
    if not isinstance(tree, tuple):
        return function(tree) if isinstance(tree, Tensor) else tree
    parts = [_map(part, function) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def _shape(tree: Any) -> object:
    """What a recording depends on."""
    if not isinstance(tree, tuple):
        return (tree.shape, tree.dtype, tree.device) if isinstance(tree, Tensor) else tree
    return (type(tree), *(_shape(part) for part in tree))
