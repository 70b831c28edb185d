"""CUDA graphs: the many small kernels of a judge, recorded once per shape and replayed as one.

A recording reads and writes memory of its own: inputs are copied into it, outputs out of it. What
cannot be recorded is computed as before, and is not tried again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

MOST_RECORDINGS: Final = 8
"""Each keeps its own memory; searches have few shapes, and further ones are computed as before."""
WARM_UP: Final = 3
"""Calls before a recording: libraries choose their kernels, constants are made and kept."""

type Replay = Callable[[], object]
type Record = Callable[[Callable[[], Any], torch.device], tuple[Replay, Any]]
"""Makes of a function without arguments, which works on a device, its replay, and what that writes
its results to."""


def record(function: Callable[[], Any], device: torch.device) -> tuple[Replay, Any]:
    """As a CUDA graph.

    Raises:
        RuntimeError: something in it cannot be recorded, such as a copy from the processor.
    """
    with torch.cuda.device(device):  # whose streams are meant; a recording of another's is empty
        return _record(function)


def _record(function: Callable[[], Any]) -> tuple[Replay, Any]:
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_UP):
            function()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # others go on meanwhile
        results = function()
    return graph.replay, results


class _Recording(NamedTuple):
    inputs: list[Tensor]  # that the replay reads
    replay: Replay
    results: Any  # that it writes


class Recorded:
    """A function of tensors, in tuples or None as well, that does the same to equal shapes.

    Args:
        function: waits for nothing, draws nothing, and has no effect but its results.
        how: makes a recording; a `RuntimeError` says that there can be none.
    """

    def __init__(self, function: Callable[..., Any], how: Record = record) -> None:
        self._function, self._how = function, how
        self._recordings: dict[object, _Recording | None] = {}

    def __call__(self, *arguments: Any) -> Any:
        """The function's results, which no later call changes."""
        key = _shape(arguments)
        if key not in self._recordings:
            full = len(self._recordings) >= MOST_RECORDINGS
            self._recordings[key] = None if full else self._record(arguments)
        recording = self._recordings[key]
        if recording is None:
            return self._function(*arguments)
        for buffer, given in zip(recording.inputs, _tensors(arguments), strict=True):
            buffer.copy_(given)
        recording.replay()
        return _map(recording.results, Tensor.clone)

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
        except RuntimeError:
            return None
        return _Recording(list(_tensors(own)), replay, results)


def _tensors(tree: Any) -> Iterator[Tensor]:
    """In the order of the tuples they are in."""
    if isinstance(tree, Tensor):
        yield tree
    elif tree is not None:
        for part in tree:
            yield from _tensors(part)


def _map(tree: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """The same tuples of other tensors."""
    if tree is None or isinstance(tree, Tensor):
        return None if tree is None else function(tree)
    parts = [_map(part, function) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def _shape(tree: Any) -> object:
    """What a recording depends on."""
    if tree is None or isinstance(tree, Tensor):
        return None if tree is None else (tree.shape, tree.dtype, tree.device)
    return (type(tree), *(_shape(part) for part in tree))
