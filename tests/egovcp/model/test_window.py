"""The recurrence over a whole window: the same states and gradients as one step after the other."""

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import Carry, WorldModel, layer_gradients
from egovcp.model.fused_recurrence import filter_window, imagine_window
from egovcp.model.latent_state import Gaussian
from egovcp.testing import toy_model

SIZE, LENGTH = 3, 6
ROWS = [4, 4, 3, 3, 1, 0]  # of each imagined tick: a window may be too short

type Run = Callable[[WorldModel, Sequence[Tensor]], list[Tensor]]


def _first() -> Tensor:
    """Episodes begin at the start, within the window, twice in a row, and not at all."""
    first = torch.zeros(SIZE, LENGTH, dtype=torch.bool)
    first[0, 0] = first[0, 3] = first[1, 1] = first[1, 2] = True
    return first


def _filter_inputs(model: WorldModel) -> list[Tensor]:
    """h, z, actions, embeddings and noise."""
    c, rng = model.config, torch.Generator().manual_seed(0)
    shapes = [(SIZE, c.hidden), (SIZE, c.latent), (SIZE, LENGTH, spec.ACTION_DIM)]
    shapes += [(SIZE, LENGTH, c.units), (LENGTH, SIZE, c.latent)]
    return [torch.randn(shape, generator=rng).to(model.state_mean) for shape in shapes]


def _filtered(model: WorldModel, inputs: Sequence[Tensor]) -> list[Tensor]:
    h, z, action, embedding, noise = inputs
    carry, posterior = filter_window(model, Carry(h, z), action, _first(), embedding, noise)
    return [carry.h, carry.z, *posterior]


def _filtered_by_steps(model: WorldModel, inputs: Sequence[Tensor]) -> list[Tensor]:
    h, z, action, embedding, noise = inputs
    first, found = _first(), []
    for t in range(LENGTH):
        h = model.advance(Carry(h, z), action[:, t], first[:, t])
        q: Gaussian = model.infer(h, embedding[:, t])
        z = q.mean + q.std * noise[t]
        found.append((h, z, *q))
    return [torch.stack(x, 1) for x in zip(*found, strict=True)]


def _imagine_inputs(model: WorldModel) -> list[Tensor]:
    """h, z and actions."""
    c, rng = model.config, torch.Generator().manual_seed(0)
    shapes = [(ROWS[0], c.hidden), (ROWS[0], c.latent), (sum(ROWS), spec.ACTION_DIM)]
    return [torch.randn(shape, generator=rng).to(model.state_mean) for shape in shapes]


def _imagined(model: WorldModel, inputs: Sequence[Tensor]) -> list[Tensor]:
    h, z, action = inputs
    return [x for c in imagine_window(model, Carry(h, z), action, ROWS) for x in (c.h, c.z)]


def _imagined_by_steps(model: WorldModel, inputs: Sequence[Tensor]) -> list[Tensor]:
    h, z, action = inputs
    carry, found = Carry(h, z), []
    for part in action.split(ROWS):
        carry = model.imagine(Carry(carry.h[: len(part)], carry.z[: len(part)]), part)
        found += [carry.h, carry.z]
    return found


CASES = {
    "filter": (_filter_inputs, _filtered, _filtered_by_steps),
    "imagine": (_imagine_inputs, _imagined, _imagined_by_steps),
}


def _scalar(outputs: Sequence[Tensor]) -> Tensor:
    """A sum in which every number of the outputs counts differently."""
    rng = torch.Generator().manual_seed(1)
    return torch.stack([(torch.randn(x.shape, generator=rng) * x).sum() for x in outputs]).sum()


def _gradients(run: Run, model: WorldModel, inputs: Sequence[Tensor]) -> dict[str, Tensor]:
    inputs = [x.clone().requires_grad_() for x in inputs[:4]] + list(inputs[4:])
    model.zero_grad()
    _scalar(run(model, inputs)).backward()  # type: ignore[no-untyped-call]
    of_inputs = {str(i): x.grad for i, x in enumerate(inputs)}
    found = of_inputs | {name: p.grad for name, p in model.named_parameters()}
    return {name: x.clone() for name, x in found.items() if x is not None}


@pytest.mark.parametrize("case", CASES)
def test_a_window_is_its_steps_one_after_the_other(case: str) -> None:
    inputs, window, steps = CASES[case]
    model = toy_model()
    with torch.no_grad():
        expected = steps(model, inputs(model))
        for x, y in zip(window(model, inputs(model)), expected, strict=True):
            torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_its_gradients_are_those_of_its_steps(case: str) -> None:
    inputs, window, steps = CASES[case]
    model = toy_model()
    found, expected = (_gradients(run, model, inputs(model)) for run in (window, steps))
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-4, atol=1e-4, msg=name)


@pytest.mark.parametrize("case", CASES)
def test_its_gradients_are_those_of_small_differences(case: str) -> None:
    inputs, window, _ = CASES[case]
    model = toy_model().double()
    given = [x.requires_grad_() for x in inputs(model)[:4]] + inputs(model)[4:]
    names = [k for k in _gradients(window, model, inputs(model)) if not k.isdigit()]
    trained = {k: p for k, p in model.named_parameters() if k in names}

    def outputs(*x: Tensor) -> tuple[Tensor, ...]:
        return tuple(window(model, x[: len(given)]))

    assert torch.autograd.gradcheck(outputs, (*given, *trained.values()), fast_mode=True)


@pytest.mark.parametrize("mixed", [True, False])
@pytest.mark.parametrize("case", CASES)
def test_in_bfloat16_it_goes_the_same_way(
    case: str, mixed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where norms want one type for numbers and weights, as on GPUs."""
    monkeypatch.setattr(layer_gradients, "_norms_mixed_dtypes", lambda device: mixed)
    inputs, window, _ = CASES[case]
    model = toy_model()
    exact = _gradients(window, model, inputs(model))
    with torch.autocast("cpu", torch.bfloat16):
        rough = _gradients(window, model, inputs(model))
    for name, gradient in exact.items():
        assert rough[name].dtype == torch.float32
        alike = torch.cosine_similarity(rough[name].flatten(), gradient.flatten(), 0)
        assert alike > 0.99, name


def test_what_is_not_trained_has_no_gradient(model: WorldModel) -> None:
    frozen = toy_model().requires_grad_(False)
    h = _filtered(frozen, _filter_inputs(frozen))[0]
    assert not h.requires_grad
    with torch.no_grad():
        assert not _filtered(model, _filter_inputs(model))[0].requires_grad


def test_a_beginning_heals_what_is_no_number(model: WorldModel) -> None:
    inputs = _filter_inputs(model)
    inputs[0][0] = torch.nan
    inputs[1][0] = torch.nan
    with torch.no_grad():
        for x in _filtered(model, inputs):
            assert torch.isfinite(x[0]).all()
            assert torch.isfinite(x[2]).all()
