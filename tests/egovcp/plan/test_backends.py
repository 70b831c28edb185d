"""Backends of the plan evaluation against the reference."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import PRESETS, Carry, WorldModel
from egovcp.model.config import LossConfig
from egovcp.plan import Plan, PlannerConfig, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.plan.backends import FloatEvaluator, Int8Evaluator, library, make_evaluator
from egovcp.plan.backends.integer_network import (
    HIDDEN_ONE,
    LEAST_SILU,
    NODES,
    STATE_ONE,
    silu_table,
    tanh_table,
)
from egovcp.plan.config import BackendName
from egovcp.plan.search import random_walk
from egovcp.robot_spec import G1
from egovcp.testing import toy_model
from tests.support.models import CountingModel

needs_compiler = pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
EXACT, BYTES = 1e-5, 0.1  # largest error, in deviations of V
TOLERANCES = [
    ("float32", EXACT),
    pytest.param("int8", BYTES, marks=needs_compiler),
]
MODELS = [
    {},
    {"value_loss": "mse"},
    {"hidden": 48, "units": 64, "latent": 12},
]
QUESTIONS = [
    {},
    {"latent": "sample"},
    {"termination_rule": "survival"},
    {"termination_rule": "paper"},
    {"objective": "reward"},
    {"objective": "td"},
    {"objective": "td", "termination_rule": "survival", "latent": "sample"},
    {"objective": "reward", "termination_rule": "paper"},
]


def _model(**change: object) -> WorldModel:
    model = toy_model(dataclasses.replace(PRESETS["debug"], **change))  # type: ignore[arg-type]
    model.return_mean.fill_(0.3)
    model.return_std.fill_(2.0)
    model.min_return.fill_(-4.0)
    return model


def _carry(model: WorldModel, robots: int = 3, seed: int = 0) -> Carry:
    rng = torch.Generator().manual_seed(seed)
    h = 2 * torch.rand(robots, model.config.hidden, generator=rng) - 1
    z = torch.randn(robots, model.config.latent, generator=rng)
    return Carry(h, z)


def _actions(robots: int = 3, plans: int = 65, horizon: int = 4, seed: int = 1) -> Tensor:
    rng = torch.Generator().manual_seed(seed)
    deltas = 2 * torch.rand(robots, plans, horizon, spec.ACTION_DIM, generator=rng) - 1
    return random_walk(torch.zeros(robots, 1, spec.ACTION_DIM), deltas, spec.ACTION_ETA)


def _values(model: WorldModel, config: PlannerConfig, carry: Carry, actions: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        return make_evaluator(model, config).at(carry)(actions, generator)


def _plan(model: WorldModel, backend: BackendName, carry: Carry) -> Plan:
    config = PlannerConfig(samples=256, elites=32, backend=backend)
    executed = torch.zeros(len(carry.h), spec.ACTION_DIM)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        evaluator = make_evaluator(model, config)
        return make_plan(evaluator, optimiser_of(config), carry, executed, config, generator)


@pytest.mark.parametrize(("backend", "tolerance"), TOLERANCES)
@pytest.mark.parametrize("change", MODELS, ids=str)
@pytest.mark.parametrize("question", QUESTIONS, ids=str)
def test_plan_values_agree_with_the_reference(
    backend: BackendName, tolerance: float, change: dict[str, object], question: dict[str, str]
) -> None:
    eager = PlannerConfig(backend="eager", **question)  # type: ignore[arg-type]
    model = _model(**change, loss=LossConfig(reward=float(eager.objective != "value")))
    carry, actions = _carry(model), _actions(horizon=eager.actions)
    expected = _values(model, eager, carry, actions)
    found = _values(model, dataclasses.replace(eager, backend=backend), carry, actions)
    error = (found - expected).abs()
    if tolerance > EXACT:  # a candidate at the threshold may end on its other side
        error = error.flatten().sort().values[: int(0.97 * error.numel())]
    assert error.max() < tolerance * expected.std()


@pytest.mark.parametrize(("backend", "tolerance"), TOLERANCES)
@pytest.mark.parametrize("horizon", [1, 2, 7])
def test_backends_agree_with_the_reference_at_any_horizon(
    backend: BackendName, tolerance: float, horizon: int
) -> None:
    model = _model()
    carry, actions = _carry(model), _actions(horizon=horizon)
    rule = PlannerConfig(backend="eager", termination_rule="survival")
    expected = _values(model, rule, carry, actions)
    found = _values(model, dataclasses.replace(rule, backend=backend), carry, actions)
    assert (found - expected).abs().max() < tolerance * expected.std()


@pytest.mark.parametrize(("backend", "tolerance"), TOLERANCES)
def test_the_same_action_is_chosen(backend: BackendName, tolerance: float) -> None:
    """Within a tenth of a step, and as good as the reference's in the reference's own eyes."""
    model = _model()
    carry = _carry(model, robots=8)
    expected, found = _plan(model, "eager", carry), _plan(model, backend, carry)
    moved = (found.actions[:, 0] - expected.actions[:, 0]).abs()
    assert moved.mean() < 0.1 * spec.ACTION_ETA
    config = PlannerConfig(backend="eager")
    worth = [_values(model, config, carry, p.actions[:, None])[:, 0] for p in (expected, found)]
    spread = _values(model, config, carry, _actions(8)).std(1)
    assert ((worth[0] - worth[1]) / spread).mean() < tolerance


@pytest.mark.parametrize(("backend", "tolerance"), TOLERANCES)
def test_values_of_a_robot_do_not_depend_on_others(backend: BackendName, tolerance: float) -> None:
    model = _model()
    carry, actions, config = _carry(model), _actions(), PlannerConfig(backend=backend)
    together = _values(model, config, carry, actions)
    for e in range(3):
        row = carry.map(lambda x, e=e: x[e : e + 1])  # type: ignore[misc]
        alone = _values(model, config, row, actions[e : e + 1])
        allowed = 0.0 if backend == "int8" else EXACT
        assert (together[e] - alone[0]).abs().max() <= allowed * together.std()


@needs_compiler
@pytest.mark.parametrize("threads", [2, 3])
def test_number_of_threads_does_not_change_values(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, config = _model(), PlannerConfig(backend="int8")
    carry, actions = _carry(model), _actions()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    one = _values(model, config, carry, actions)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    assert torch.equal(one, _values(model, config, carry, actions))


@needs_compiler
def test_idle_threads_are_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    model, config = _model(), PlannerConfig(backend="int8")
    evaluator, actions = make_evaluator(model, config), _actions()
    with torch.no_grad():
        plan_value = evaluator.at(_carry(model))
        first = plan_value(actions, None)
        for pause in (0.0, 0.02, 0.001, 0.02):
            time.sleep(pause)
            assert plan_value(actions, None).equal(first)


@pytest.mark.parametrize(("backend", "tolerance"), TOLERANCES)
def test_nan_affects_only_its_own_plan(backend: BackendName, tolerance: float) -> None:
    model, config = _model(), PlannerConfig(backend=backend)
    carry, actions = _carry(model), _actions()
    sound = _values(model, config, carry, actions)
    carry.h[1, 0] = torch.nan
    actions[2, 5, 3, 0] = torch.nan
    found = _values(model, config, carry, actions)
    lost = torch.zeros_like(found, dtype=torch.bool)
    lost[1], lost[2, 5] = True, True
    assert found.isnan().equal(lost)
    torch.testing.assert_close(found[~lost], sound[~lost], rtol=1e-3, atol=1e-3)


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where kernels for other processors are kept, so that each is compiled once."""
    return tmp_path_factory.mktemp("kernels")


@needs_compiler
@pytest.mark.parametrize(
    "vectors",
    [
        (),
        pytest.param(
            ("-mavx2", "-mfma"),
            marks=pytest.mark.skipif(not library.processor_has("avx2"), reason="no AVX2"),
        ),
    ],
    ids=["no vectors", "AVX2"],
)
@pytest.mark.parametrize(
    ("kind", "objective"), [("mse", "value"), ("two_hot", "value"), ("mse", "td")]
)
def test_the_kernel_agrees_across_vector_widths(
    kind: str,
    objective: Any,
    vectors: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    kernels: Path,
) -> None:
    model = _model(value_loss=kind, loss=LossConfig(reward=1.0))
    config = PlannerConfig(backend="int8", objective=objective)
    carry, actions = _carry(model), _actions(horizon=config.actions)
    here = _values(model, config, carry, actions)
    plain = tuple(flag for flag in library.FLAGS if not flag.startswith("-m"))
    monkeypatch.setattr(library, "FLAGS", (*plain, *vectors))
    cache = kernels / "-".join(("kernel", *vectors))
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    library.load_kernel.cache_clear()
    try:
        elsewhere = _values(model, config, carry, actions)
        assert len(list(cache.rglob("*.so"))) == 1
    finally:
        library.load_kernel.cache_clear()
    error = (here - elsewhere).abs().flatten().sort().values
    assert error[: int(0.97 * len(error))].max() < 0.02 * here.std()


@needs_compiler
@pytest.mark.skipif(not library.request_amx_tiles(), reason="no AMX")
@pytest.mark.parametrize("change", MODELS)
def test_kernel_without_tiles_is_bit_identical(
    change: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, config = _model(**change), PlannerConfig(backend="int8")
    carry, actions = _carry(model), _actions()
    tiles = _values(model, config, carry, actions)
    monkeypatch.setattr(library, "request_amx_tiles", lambda: False)
    library.load_kernel.cache_clear()
    try:
        vectors = _values(model, config, carry, actions)
        assert library.weight_layout(library.load_kernel()).depth < 64
    finally:
        library.load_kernel.cache_clear()
    assert torch.equal(tiles, vectors)


@needs_compiler
def test_unsupported_sizes_are_refused_by_int8_and_planned_in_float32_by_auto() -> None:
    model = _model(units=20)
    with pytest.raises(UsageError, match=r"20 units.*float32"):
        make_evaluator(model, PlannerConfig(backend="int8"))
    assert isinstance(make_evaluator(model, PlannerConfig(backend="auto")), FloatEvaluator)


@needs_compiler
def test_plans_too_long_for_the_stack_of_the_kernel_are_refused() -> None:
    names = tuple(f"joint_{i}" for i in range(64))
    box = spec.ActionBox(*((value,) * 64 for value in (-1.0, 0.0, 1.0)))
    robot = dataclasses.replace(
        G1, robot_type="crane", mirror=None, action_names=names, action_box=box
    )
    model = toy_model(robot=robot)
    make_evaluator(model, PlannerConfig(backend="int8", horizon=200))
    with pytest.raises(UsageError, match=r"300 steps of 64 actions.*float32"):
        make_evaluator(model, PlannerConfig(backend="int8", horizon=300))


@needs_compiler
def test_auto_selects_int8_on_fast_processors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for fast, kind in ((True, Int8Evaluator), (False, FloatEvaluator)):
        monkeypatch.setattr(library, "processor_is_fast", lambda fast=fast: fast)
        assert isinstance(make_evaluator(toy_model(), PlannerConfig()), kind)


def test_subclass_of_the_world_model_is_evaluated_by_the_reference() -> None:
    assert isinstance(make_evaluator(CountingModel(), PlannerConfig()), ReferenceEvaluator)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_gpu_values_agree_with_the_reference() -> None:
    model = _model()
    carry, actions = _carry(model), _actions()
    expected = _values(model, PlannerConfig(backend="eager"), carry, actions)
    there = carry.map(lambda x: x.cuda())
    with torch.no_grad():
        evaluator = make_evaluator(model.cuda(), PlannerConfig(backend="float32"))
        found = evaluator.at(there)(actions.cuda(), None).cpu()
    assert (found - expected).abs().median() < 1e-3 * expected.std()


def _on_lines(table: Tensor, reach: float, unit: int, a: Tensor) -> Tensor:
    """As the kernel, but for its rounding."""
    places = a * NODES / reach
    node = places.round().clamp(max=NODES - 1)
    value, rise = table.double() / unit
    return value[node.long()] + rise[node.long()] * 2 * (places - node)


@pytest.mark.parametrize(
    ("function", "table", "reach", "unit", "allowed"),
    [
        (lambda a: -a * torch.sigmoid(-a), silu_table(), 8.0, HIDDEN_ONE, 1e-3),
        (torch.tanh, tanh_table(), 4.0, STATE_ONE, 3e-4),
    ],
    ids=["silu", "tanh"],
)
def test_activation_tables_approximate_their_functions(
    function: Callable[[Tensor], Tensor], table: Tensor, reach: float, unit: int, allowed: float
) -> None:
    a = torch.linspace(0, reach, 10_001, dtype=torch.float64)
    error = (_on_lines(table, reach, unit, a) - function(a)).abs()
    assert error.max() < allowed


def test_byte_offset_of_hidden_layers_is_below_the_minimum_of_silu() -> None:
    x = torch.linspace(-3, 0, 10_001)
    assert torch.nn.functional.silu(x).min() > LEAST_SILU
    assert silu_table()[0].min() / HIDDEN_ONE > LEAST_SILU
