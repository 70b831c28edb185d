"""The fit of the privileged value, and training with it."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from egovcp import spec
from egovcp.data import EpisodeIndex, EpisodeStore, open_dataset
from egovcp.model import WorldModel
from egovcp.testing import toy_model
from egovcp_train import privileged_value
from egovcp_train.checkpoint import load_training_state
from egovcp_train.config import PrivilegedValueConfig
from egovcp_train.privileged_value import PrivilegedRows
from egovcp_train.train import main

type Arguments = Callable[..., list[str]]

_CONFIG = PrivilegedValueConfig(updates=300, rows=128, lr=3e-3)


@pytest.fixture
def store(dataset_root: Path) -> EpisodeStore:
    return EpisodeStore.read(EpisodeIndex.of([open_dataset(dataset_root)]))


def _labelled(store: EpisodeStore) -> EpisodeStore:
    """The return is the height of the object minus the commanded height; both mirror to
    themselves."""
    height = store.privileged[:, 2] - store.action[:, 6]
    store.privileged[:, spec.OBJECT_KNOWN] = 1.0
    return dataclasses.replace(
        store,
        state=np.zeros_like(store.state),
        mc_return=height.astype(np.float32),
        mc_valid=np.ones(store.num_frames, np.bool_),
    )


def _model() -> WorldModel:
    model = toy_model()
    model.return_mean.fill_(0.0)
    model.return_std.fill_(1.0)
    return model


def test_it_explains_returns_of_the_object_and_the_action(store: EpisodeStore) -> None:
    store, model = _labelled(store), _model()
    rows = PrivilegedRows(model, store)
    value = privileged_value.fit(model, store, _CONFIG, seed=0)
    assert min(rows.explained(value).values()) > 0.9
    state, features, action = (x[:50] for x in rows.inputs)
    raised = action.clone()
    raised[:, 6] += 0.3
    change = value(state, features, raised) - value(state, features, action)
    assert float(change.mean()) == pytest.approx(-0.3, abs=0.1)
    nothing = privileged_value.fit(model, store, PrivilegedValueConfig(1, 8, 1e-9), seed=0)
    assert max(rows.explained(nothing).values()) < 0.1


def test_equal_seeds_give_equal_values_and_leave_the_random_state(store: EpisodeStore) -> None:
    model, config = _model(), PrivilegedValueConfig(updates=3, rows=16)
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second, other = (
        privileged_value.fit(model, _labelled(store), config, seed).state_dict()
        for seed in (0, 0, 1)
    )
    assert torch.equal(torch.rand(3), expected)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_half_of_the_rows_are_mirrored(store: EpisodeStore) -> None:
    rows = PrivilegedRows(_model(), _labelled(store))
    (_, _, action), _ = rows.sample(4000, torch.Generator().manual_seed(0))
    own = (action[:, None] == rows.inputs[2][None]).all(-1).any(1)
    assert float(own.float().mean()) == pytest.approx(0.5, abs=0.05)


def test_every_dataset_must_know_its_objects(store: EpisodeStore) -> None:
    known = store.privileged[:, spec.OBJECT_KNOWN]
    known[:] = 0.0
    assert not privileged_value.has_objects(store)
    known[0] = 1.0
    assert privileged_value.has_objects(store)
    dataset = np.arange(len(store.length)) % 2
    assert not privileged_value.has_objects(dataclasses.replace(store, dataset=dataset))


@pytest.mark.parametrize("mode", ["ram", "stream"])
def test_a_run_fits_it_once_and_keeps_it(
    mode: str, arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main(arguments(run, steps=2, loading__mode=mode)) == 0
    assert "the privileged value explains" in capsys.readouterr().out
    before = load_training_state(run)["learner"]["privileged_value"]
    assert main([f"--output_dir={run}", "--resume", "--steps=4"]) == 0
    assert "the privileged value explains" not in capsys.readouterr().out
    after = load_training_state(run)["learner"]["privileged_value"]
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("q_target", ["mc", "td"])
def test_other_targets_do_without(q_target: str, arguments: Arguments, tmp_path: Path) -> None:
    assert main(arguments(tmp_path / "run", steps=2, policy__loss__q_target=q_target)) == 0
    assert "privileged_value" not in load_training_state(tmp_path / "run")["learner"]


def test_data_without_objects_falls_back_to_returns(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(privileged_value, "has_objects", lambda store: False)
    assert main(arguments(tmp_path / "run", steps=2)) == 0
    assert "the data has no positions of objects: Q is fitted to returns" in capsys.readouterr().out
    assert "privileged_value" not in load_training_state(tmp_path / "run")["learner"]
