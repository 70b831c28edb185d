"""Initialisation of the networks, and the interface of the value head."""

import pytest
import torch

from egovcp import spec
from egovcp.model import PRESETS, WorldModel
from egovcp.model.networks import SplitLinear, SplitMlp


def test_split_linear_is_a_linear_on_the_concatenated_inputs():
    layer = SplitLinear((7, 2), 5)
    joined = torch.nn.Linear(9, 5, bias=False)
    joined.weight.data = torch.cat([part.weight for part in layer.parts], 1)
    first, second = torch.randn(3, 7), torch.randn(3, 2)
    torch.testing.assert_close(layer(first, second), joined(torch.cat([first, second], 1)))


def test_split_linear_is_initialised_by_the_number_of_all_inputs():
    """Like a Linear with 7 + 2 inputs: weights uniform within 1 / sqrt(9)."""
    torch.manual_seed(0)
    for part in SplitLinear((7, 2), 512).parts:
        weight = part.weight.detach()
        assert float(weight.abs().max()) <= 1 / 3
        assert float(weight.std()) == pytest.approx(1 / 3 / 3**0.5, rel=0.1)


def test_start_at_zero_makes_all_outputs_zero():
    mlp = SplitMlp((7, 2), 16, 3, hidden_layers=2)
    inputs = torch.randn(4, 7), torch.randn(4, 2)
    assert mlp(*inputs).any()
    mlp.start_at_zero()
    assert not mlp(*inputs).any()


def test_value_head_reads_the_whole_state_and_the_action():
    config = PRESETS["debug"]
    head = WorldModel(config).value_head
    assert [part.in_features for part in head.first.parts] == [
        config.hidden,
        config.latent,
        spec.ACTION_DIM,
    ]
