"""Captures functions of tensors as CUDA graphs, one per shape of the arguments.

A plan or a gradient step launches many small kernels; replaying a graph launches all of them at
once. A graph reads and writes its own memory: arguments are copied into it. A function that cannot
be captured is called directly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

MAX_GRAPHS: Final = 8
WARM_UP_CALLS: Final = 3
"""Calls before a capture, in which libraries choose kernels and constants are created."""

type Replay = Callable[[], object]
type Capture = Callable[[Callable[[], Any], torch.device], tuple[Replay, Any]]
"""(function without arguments, device) -> (replay, results that the replay overwrites)."""


def capture_graph(
    pools: dict[torch.device, Any], function: Callable[[], Any], device: torch.device
) -> tuple[Replay, Any]:
    """A `Capture` whose graphs share the memory of ``pools``: one may be replayed at a time.

    Raises:
        RuntimeError: the function has an operation that cannot be captured.
    """
    with torch.cuda.device(device):  # a capture on another device's stream is empty
        pool = pools.setdefault(device, torch.cuda.graph_pool_handle())
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP_CALLS):
                function()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # other threads may work
        with torch.cuda.graph(graph, pool, capture_error_mode="thread_local"):
            results = function()
    return graph.replay, results


class _Graph(NamedTuple):
    inputs: list[Tensor]
    replay: Replay
    results: Any


class GraphedFunction:
    """A function that is captured once per argument shapes and autocast dtype, then replayed.

    Args:
        function: takes and returns tensors, None, or tuples of them; without synchronisation,
            random numbers and side effects. Arguments other than tensors are part of the shape.
        capture: makes a graph, or raises `RuntimeError`; None: `capture_graph`.
        max_graphs: most shapes, failed captures included; others run without a graph.
        copies: return copies of the results, which later calls do not overwrite.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        capture: Capture | None = None,
        max_graphs: int = MAX_GRAPHS,
        copies: bool = True,
    ) -> None:
        self._function, self._capture = function, capture or partial(capture_graph, {})
        self._max_graphs, self._copies = max_graphs, copies
        self._graphs: dict[object, _Graph | None] = {}
        self.error = ""
        """Error of the last failed capture; empty: none failed."""

    def __call__(self, *arguments: Any) -> Any:
        """The results of the function."""
        device_type = next(_tensors(arguments)).device.type
        autocast = torch.is_autocast_enabled(device_type) and torch.get_autocast_dtype(device_type)
        key = autocast, _shape(arguments)
        if key not in self._graphs:
            full = len(self._graphs) >= self._max_graphs
            self._graphs[key] = None if full else self._make(arguments)
        graph = self._graphs[key]
        if graph is None:
            return self._function(*arguments)
        for buffer, given in zip(graph.inputs, _tensors(arguments), strict=True):
            buffer.copy_(given)
        graph.replay()
        return _map(graph.results, Tensor.clone) if self._copies else graph.results

    @torch.inference_mode(False)  # buffers are written under both modes
    @torch.no_grad()
    def _make(self, arguments: tuple[Any, ...]) -> _Graph | None:
        own = _map(arguments, lambda x: x.detach().clone(memory_format=torch.contiguous_format))
        try:
            device = next(_tensors(own)).device
            replay, results = self._capture(lambda: self._function(*own), device)
        except RuntimeError as error:
            self.error = " ".join(str(error).split())[:200]
            return None
        return _Graph(list(_tensors(own)), replay, results)


def _tensors(tree: Any) -> Iterator[Tensor]:
    if isinstance(tree, Tensor):
        yield tree
    elif isinstance(tree, tuple):
        for part in tree:
            yield from _tensors(part)


def _map(tree: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """Apply a function to the tensors in nested tuples."""
    if not isinstance(tree, tuple):
        return function(tree) if isinstance(tree, Tensor) else tree
    parts = [_map(part, function) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def _shape(tree: Any) -> object:
    """Part of a graph's key: shapes, dtypes and devices of the tensors, and all other values."""
    if not isinstance(tree, tuple):
        return (tree.shape, tree.dtype, tree.device) if isinstance(tree, Tensor) else tree
    return (type(tree), *(_shape(part) for part in tree))
