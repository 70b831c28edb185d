"""The heads of Q and what they are told."""

import copy

import pytest
import torch

from egovcp.errors import UsageError
from egovcp.model import LossConfig, WorldModel, WorldModelConfig
from egovcp.model.nets import SplitMlp


def test_a_restarted_mlp_starts_like_a_new_one():
    """One Linear on all inputs: each part's weights stay below 1 / sqrt(7 + 2)."""
    torch.manual_seed(0)
    mlp = SplitMlp((7, 2), 512, 1, hidden_layers=2)
    before = copy.deepcopy(mlp.state_dict())
    mlp.restart()
    for new, old in zip(mlp.first.parts, SplitMlp((7, 2), 512, 1).first.parts, strict=True):
        assert float(new.weight.detach().abs().max()) <= 1 / 3
        assert float(new.weight.detach().std()) == pytest.approx(
            float(old.weight.detach().std()), rel=0.1
        )
    assert not torch.equal(mlp.state_dict()["first.parts.0.weight"], before["first.parts.0.weight"])
    assert not torch.equal(mlp.state_dict()["rest.2.weight"], before["rest.2.weight"])
    assert not mlp(torch.randn(3, 7), torch.randn(3, 2)).any()


def test_a_value_told_of_what_nothing_teaches_is_refused():
    with pytest.raises(UsageError, match=r"value_of_passing.*loss\.passing"):
        WorldModelConfig(loss=LossConfig(passing=0.0))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"loss": LossConfig(motion=0.0)}, r"paint_flight.*loss\.motion"),
        ({"motion_ahead": (3,)}, r"motion_ahead \[3\].*first must be 0"),
    ],
)
def test_nothing_is_painted_where_nothing_teaches_the_place(config, message):
    with pytest.raises(UsageError, match=message):
        WorldModelConfig(**config)


@pytest.mark.parametrize("told", [False, True])
def test_q_has_a_part_for_what_is_on_its_way_only_if_told(told):
    model = WorldModel(WorldModelConfig(value_of_passing=told))
    assert (model.passing_value_head is not None) == told
