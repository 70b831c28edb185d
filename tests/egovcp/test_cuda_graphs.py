"""Recordings of a plan or a step: one per shape, into memory of their own."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.cuda_graphs import MAX_GRAPHS, GraphedFunction
from egovcp.model import PRESETS, Carry
from egovcp.plan import PlannerConfig, ReferenceEvaluator
from egovcp.plan.backends import FloatEvaluator
from egovcp.testing import toy_model
from tests.support.cuda_graphs import RecomputingCapture


class _Pair(NamedTuple):
    sum: Tensor
    parts: tuple[Tensor, ...]


def _function(a: Tensor, rest: tuple[Tensor, Tensor | None]) -> _Pair:
    b, c = rest
    return _Pair(a + b if c is None else a + b + c, (2 * a,))


def _arguments(size: int, seed: int, third: bool = True) -> tuple[Tensor, Any]:
    rng = torch.Generator().manual_seed(seed)
    a, b, c = torch.rand(3, size, generator=rng)
    return a, (b, c if third else None)


def test_a_graph_is_reused_for_equal_shapes_only() -> None:
    recorder = RecomputingCapture()
    recorded = GraphedFunction(_function, recorder)
    for seed in range(3):
        for size, third in ((4, True), (5, True), (4, False)):
            given = _arguments(size, seed, third)
            found, expected = recorded(*given), _function(*given)
            torch.testing.assert_close(found.sum, expected.sum)
            torch.testing.assert_close(found.parts[0], expected.parts[0])
    assert recorder.captures == 3


def test_inputs_and_earlier_results_do_not_change() -> None:
    recorded = GraphedFunction(_function, RecomputingCapture())
    given = _arguments(4, 0)
    before = [given[0].clone(), given[1][0].clone()]
    first = recorded(*given)
    kept = first.sum.clone()
    recorded(*_arguments(4, 1))
    assert first.sum.equal(kept)
    assert given[0].equal(before[0])
    assert given[1][0].equal(before[1])


def test_graphs_work_under_no_grad_and_inference_mode() -> None:
    recorded = GraphedFunction(_function, RecomputingCapture())
    for mode in (torch.inference_mode, torch.no_grad, torch.inference_mode):
        with mode():
            given = _arguments(4, 2)
            assert recorded(*given).sum.equal(_function(*given).sum)


def test_a_failed_capture_is_not_repeated() -> None:
    tried = []

    def refuse(
        function: Callable[[], Any], device: torch.device
    ) -> tuple[Callable[[], object], Any]:
        tried.append(function)
        raise RuntimeError("operation not permitted when stream is capturing")

    recorded = GraphedFunction(_function, refuse)
    for seed in range(3):
        given = _arguments(4, seed)
        assert recorded(*given).sum.equal(_function(*given).sum)
    assert len(tried) == 1
    assert recorded.error == "operation not permitted when stream is capturing"


def test_shapes_beyond_the_limit_are_computed_without_a_graph() -> None:
    recorder = RecomputingCapture()
    recorded = GraphedFunction(_function, recorder)
    for size in range(1, MAX_GRAPHS + 4):
        given = _arguments(size, size)
        assert recorded(*given).sum.equal(_function(*given).sum)
    assert recorder.captures == MAX_GRAPHS


def test_other_arguments_are_part_of_the_key() -> None:
    def scaled(x: Tensor, by: int) -> tuple[str, Tensor]:
        return f"by {by}", by * x

    recorder = RecomputingCapture()
    recorded = GraphedFunction(scaled, recorder)
    for by in (2, 3, 2, 3):
        x = torch.rand(4)
        name, found = recorded(x, by)
        assert name == f"by {by}"
        assert found.equal(by * x)
    assert recorder.captures == 2


def test_autocast_is_part_of_the_key() -> None:
    recorder = RecomputingCapture()
    recorded = GraphedFunction(torch.matmul, recorder)
    x = torch.rand(4, 4)
    for bf16 in (True, False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            assert recorded(x, x).dtype == (torch.bfloat16 if bf16 else torch.float32)
    assert recorder.captures == 2


def test_uncopied_results_are_overwritten_by_the_next_call() -> None:
    recorded = GraphedFunction(_function, RecomputingCapture(), copies=False)
    first = recorded(*_arguments(4, 0))
    second = recorded(*_arguments(4, 1))
    assert first.sum is second.sum
    assert second.sum.equal(_function(*_arguments(4, 1)).sum)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_replayed_evaluator_agrees_with_the_model_on_a_gpu() -> None:
    model = toy_model(PRESETS["debug"]).cuda()
    evaluator = FloatEvaluator(model, PlannerConfig())
    reference = ReferenceEvaluator(model, PlannerConfig())
    rng = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for _ in range(3):
            start = model.initial(2)
            h = torch.rand(start.h.shape, generator=rng).cuda()
            carry = Carry(h, torch.randn(start.z.shape, generator=rng).cuda())
            actions = 2 * torch.rand(2, 65, 4, spec.ACTION_DIM, generator=rng).cuda() - 1
            found, expected = (j.at(carry)(actions, None) for j in (evaluator, reference))
            torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
    for function in (evaluator._prefix, evaluator._plan_value):
        assert isinstance(function, GraphedFunction)
        assert not function.error
