"""The fit of the privileged value, and training with it."""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from tqdm import tqdm

from egovcp import spec
from egovcp.data import EpisodeIndex, EpisodeStore, open_dataset
from egovcp.model import WorldModel
from egovcp.model.losses import filter_sequence
from egovcp.model.privileged_value import PrivilegedValue, sample_actions
from egovcp.plan import PlannerConfig
from egovcp.testing import random_batch, toy_model
from egovcp_train import privileged_value
from egovcp_train.checkpoint import load_training_state
from egovcp_train.config import PRESETS, PrivilegedValueConfig
from egovcp_train.loop import Budget
from egovcp_train.privileged_value import Critic, Transitions
from egovcp_train.train import main
from tests.support.arguments import Arguments

_CONFIG = PrivilegedValueConfig(updates=600, rows=128, lr=3e-3)
_PLANNER = PlannerConfig()


@pytest.fixture
def store(dataset_root: Path) -> EpisodeStore:
    return EpisodeStore.read(EpisodeIndex.of([open_dataset(dataset_root)]))


def _rewarded(store: EpisodeStore) -> EpisodeStore:
    """The reward is the height of the object minus the commanded height; both mirror to
    themselves."""
    height = store.privileged[:, 2] - store.action[:, 6]
    store.privileged[:, spec.OBJECT_KNOWN] = 1.0
    return dataclasses.replace(
        store,
        state=np.zeros_like(store.state),
        reward=height.astype(np.float32),
        terminal_next=np.zeros(store.num_frames, np.bool_),
    )


def _model(gamma: float = 0.0) -> WorldModel:
    model = toy_model()
    model.return_mean.fill_(0.0)
    model.return_std.fill_(1.0)
    model.discount.fill_(gamma)
    return model


def _fit(
    model: WorldModel, store: EpisodeStore, config: PrivilegedValueConfig, seed: int = 0
) -> Critic:
    progress = Budget(config.updates, max_minutes=0.0).progress
    return privileged_value.fit(model, store, config, _PLANNER, seed, progress)


def _changes(value: PrivilegedValue, rows: Transitions, column: int, by: float) -> torch.Tensor:
    """Change of the value of some rows if one action is changed."""
    state, features, action = (x[:50] for x in rows.inputs)
    other = action.clone()
    other[:, column] += by
    return (value(state, features, other) - value(state, features, action)).detach()


def test_without_a_future_it_is_the_reward_of_object_and_action(store: EpisodeStore) -> None:
    store, model = _rewarded(store), _model()
    value = _fit(model, store, _CONFIG).value
    rows = Transitions(model, store)
    reward = value(*rows.inputs).detach()
    assert float((reward - rows.reward).square().mean() / rows.reward.var()) < 0.1
    assert float(_changes(value, rows, 6, 0.3).mean()) == pytest.approx(-0.3, abs=0.1)


@pytest.mark.parametrize(("steps", "updates"), [(6000, 5000), (1000, 5000), (100, 500), (1, 5)])
def test_a_short_run_has_a_short_fit(steps: int, updates: int) -> None:
    config = dataclasses.replace(PRESETS["default"](), steps=steps)
    assert config.critic_fit == PrivilegedValueConfig(updates=updates)


def test_next_actions_are_those_of_the_planner() -> None:
    """Within the rate limit, at the cost of a change, a lower command is better."""
    previous = torch.zeros(40, 7)
    sampled = sample_actions(previous[:, None], 14, torch.Generator().manual_seed(0))[:, 0]
    actions = privileged_value._candidates(previous, sampled)
    returns = -actions[..., 6]

    def chosen(planner: PlannerConfig) -> torch.Tensor:
        critic = Critic(PrivilegedValue(3), planner, lr=1e-3)
        best = critic._best(returns, actions, previous, torch.tensor(0.97))
        return actions[torch.arange(40), best]

    free = chosen(PlannerConfig(pose_cost=0.0, action_rate_cost=0.0))
    assert float(free[:, 6].max()) < 0.0
    assert float(free.abs().max()) <= spec.ACTION_RATE_LIMIT + 1e-6
    assert float(free[:, 6].mean()) < -0.7 * spec.ACTION_RATE_LIMIT
    assert not chosen(PlannerConfig(pose_cost=0.0, action_rate_cost=1e6)).any()  # it holds


def test_while_a_model_is_trained_its_q_chooses_the_next_action(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The target is r + gamma V'(s', a'), with a' the best by the model of all candidates."""
    monkeypatch.setattr(privileged_value, "_OBJECT_ERROR", 0.0)
    model, batch = toy_model().requires_grad_(False), random_batch(2, 5)
    model.discount.fill_(0.9)
    batch.terminal_next[0, 1] = True
    batch.valid[1, 3:] = False
    torch.manual_seed(0)
    value = PrivilegedValue(batch.privileged.shape[-1])
    torch.nn.init.normal_(value.network.rest[-1].weight)  # type: ignore[arg-type]
    planner = PlannerConfig(pose_cost=0.0, action_rate_cost=0.0)
    critic = Critic(value, planner, lr=1e-3)
    states = filter_sequence(model, batch).carry
    sampled = sample_actions(batch.prev_action, 5, torch.Generator().manual_seed(0))
    found = critic.compute_gradients(model, batch, states, sampled)

    def error(b: int, t: int) -> torch.Tensor:
        k, later = t + 1, torch.zeros(())
        if (b, t) != (0, 1):  # which failed
            actions = privileged_value._candidates(
                batch.prev_action[b, k], batch.action[b, k][None], sampled[b, k]
            )
            carry = states.map(lambda x: x[b, k].expand(len(actions), -1))
            best = actions[model.value(carry, actions).argmax()]
            later = value(state[b, k], batch.privileged[b, k], best) * model.return_std
            later = later + model.return_mean
        expected = (batch.reward[b, t] + 0.9 * later - model.return_mean) / model.return_std
        return (
            value(state[b, t], batch.privileged[b, t], batch.action[b, t]) - expected.detach()
        ) ** 2

    state = model.standardise(batch.state)
    with_successor = [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0), (1, 1)]
    loss = torch.stack([error(b, t) for b, t in with_successor]).mean()
    torch.testing.assert_close(found, loss.detach())
    expected = torch.autograd.grad(loss, critic.parameters)
    for parameter, gradient in zip(critic.parameters, expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-3)


def test_the_target_network_follows_the_value() -> None:
    critic = Critic(PrivilegedValue(3), _PLANNER, lr=1e-2)
    before = [x.clone() for x in critic._target.parameters()]
    for parameter in critic.parameters:
        parameter.grad = torch.ones_like(parameter)
    for _ in range(300):
        critic.step()
    moved = zip(critic._target.parameters(), critic.parameters, before, strict=True)
    for target, own, old in moved:
        assert (own < old).all()
        assert (own < target).all()
        assert (target < old).all()


@pytest.mark.parametrize("failed", [False, True])
def test_after_a_failure_nothing_is_expected(store: EpisodeStore, failed: bool) -> None:
    store = _rewarded(store)
    ones = np.ones(store.num_frames, np.float32)
    ended = np.full(store.num_frames, failed)
    store = dataclasses.replace(store, reward=ones, terminal_next=ended)
    config = PrivilegedValueConfig(updates=150, rows=32, lr=3e-3)
    value = _fit(_model(0.5), store, config).value
    expected = value(*Transitions(_model(), store).inputs).detach().mean()
    assert float(expected) == pytest.approx(1.0 if failed else 2.0, abs=0.1)


def test_the_time_limit_ends_the_fit(store: EpisodeStore) -> None:
    """Its learning rate has decayed by then."""
    seconds = iter(range(1000))
    progress = Budget(1000, 0.1, clock=lambda: float(next(seconds))).progress
    config = PrivilegedValueConfig(updates=1000, rows=16, lr=1e-2)
    critic = privileged_value.fit(_model(0.9), store, config, _PLANNER, 0, progress)
    assert critic.state_dict()["updates"] == 5


def test_a_fit_without_progress_bar_ends(
    store: EpisodeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with TQDM_DISABLE=1."""
    monkeypatch.setattr(privileged_value, "tqdm", partial(tqdm, disable=True))
    seen: list[int] = []

    def progress(updates: int) -> float:
        seen.append(updates)
        assert len(seen) < 10, "endless"
        return updates / 3

    config = PrivilegedValueConfig(updates=3, rows=16)
    privileged_value.fit(_model(), store, config, _PLANNER, 0, progress)
    assert seen == [0, 1, 2, 3]


def test_equal_seeds_give_equal_values_and_leave_the_random_state(store: EpisodeStore) -> None:
    model, config = _model(0.9), PrivilegedValueConfig(updates=3, rows=16)
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second, other = (
        _fit(model, _rewarded(store), config, seed).value.state_dict() for seed in (0, 0, 1)
    )
    assert torch.equal(torch.rand(3), expected)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_rows_are_followed_by_their_next_row_and_half_are_mirrored(store: EpisodeStore) -> None:
    store = dataclasses.replace(_rewarded(store), reward=np.arange(store.num_frames, dtype="f4"))
    rows = Transitions(_model(), store)
    now, reward, then, failed = rows.sample(4000, torch.Generator().manual_seed(0))
    index = reward.long()
    own = (now.action == rows.inputs.action[index]).all(-1)
    error = (now.features - rows.inputs.features[index])[own]
    assert torch.allclose(error, (then.features - rows.inputs.features[index + 1])[own], atol=1e-5)
    std = error[:, spec.OBJECT_STATE].std(0)
    expected = privileged_value._OBJECT_ERROR * rows.model.object_std
    torch.testing.assert_close(std, expected, rtol=0.1, atol=0)
    assert not error[:, spec.OBJECT_KNOWN :].any()
    assert torch.equal(now.action[~own], rows.mirrored.action[index[~own]])
    assert float(own.float().mean()) == pytest.approx(0.5, abs=0.05)
    assert torch.equal(then.action[own], rows.inputs.action[index[own] + 1])
    assert torch.equal(then.action[~own], rows.mirrored.action[index[~own] + 1])
    assert not failed.any()
    assert not np.isin(index.numpy(), store.start + store.length - 1).any()


@pytest.mark.parametrize("mirror", [True, False])
def test_rows_are_mirrored_where_windows_are(
    mirror: bool,
    store: EpisodeStore,
    arguments: Arguments,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = Transitions(_model(), store, mirror)
    assert (rows.mirrored is rows.inputs) == (not mirror)
    made: list[bool] = []

    def record(model: WorldModel, store: EpisodeStore, mirror: bool) -> Transitions:
        made.append(mirror)
        return Transitions(model, store, mirror)

    monkeypatch.setattr(privileged_value, "Transitions", record)
    assert main(arguments(tmp_path / "run", steps=1, sampling__mirror=mirror)) == 0
    assert made == [mirror]


def test_every_task_of_every_dataset_must_know_its_objects(store: EpisodeStore) -> None:
    known = store.privileged[:, spec.OBJECT_KNOWN]
    known[:] = 0.0
    assert not privileged_value.has_objects(store)
    known[0] = 1.0
    assert privileged_value.has_objects(store)
    count = len(store.length)
    others = {"dataset": np.arange(count) % 2, "tasks": ("ball", "wall") * (count // 2)}
    for name, value in others.items():
        other = dataclasses.replace(store, **{name: value})  # type: ignore[arg-type]
        assert not privileged_value.has_objects(other)
        known[store.start[1]] = 1.0
        assert privileged_value.has_objects(other)
        known[store.start[1]] = 0.0


@pytest.mark.parametrize("mode", ["ram", "stream"])
def test_a_run_fits_it_once_and_trains_it_further(
    mode: str, arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main(arguments(run, steps=2, loading__mode=mode)) == 0
    assert "privileged value: correlation" in capsys.readouterr().out
    before = load_training_state(run)["learner"]["critic"]
    assert main([f"--output_dir={run}", "--resume", "--steps=4"]) == 0
    assert "privileged value: correlation" not in capsys.readouterr().out
    after = load_training_state(run)["learner"]["critic"]
    assert after["updates"] == before["updates"] + 2


@pytest.mark.parametrize("q_target", ["mc", "td"])
def test_other_targets_do_without(q_target: str, arguments: Arguments, tmp_path: Path) -> None:
    assert main(arguments(tmp_path / "run", steps=2, policy__loss__q_target=q_target)) == 0
    assert load_training_state(tmp_path / "run")["learner"]["critic"] is None


@pytest.mark.parametrize("mode", ["ram", "stream"])
def test_training_data_without_objects_falls_back_to_returns(
    mode: str,
    arguments: Arguments,
    dataset_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[EpisodeStore] = []
    monkeypatch.setattr(privileged_value, "has_objects", asked.append)
    assert main(arguments(tmp_path / "run", steps=2, loading__mode=mode)) == 0
    said = "not every task of each dataset has positions of objects: Q is fitted to returns"
    assert said in capsys.readouterr().out
    assert asked[0].identities == EpisodeIndex.of([open_dataset(dataset_root)], "train").identities
    assert (len(asked[0].depth) > 0) == (mode == "ram")
    assert load_training_state(tmp_path / "run")["learner"]["critic"] is None
