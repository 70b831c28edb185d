"""The final fit of Q: which states it sees, what it changes, and that it helps."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    EpisodeStore,
    ReturnConfig,
    SequenceStream,
    StreamConfig,
)
from egovcp.errors import UsageError
from egovcp.model import PRESETS, Batch, Carry, WorldModel, value
from egovcp.model.config import ValueLoss
from egovcp.testing import CountingModel, toy_model
from egovcp_train import batches, value_fit
from egovcp_train.batches import (
    mirrored_episodes,
    set_normalisation,
    to_tensors,
    whole_episodes,
)
from egovcp_train.value_fit import (
    Mirrored,
    Rows,
    ToldWhere,
    ValueFitConfig,
    _fit_heads,
    collect_rows,
    fit_value,
)

COUNT, IMAGINED = CountingModel.COUNT, CountingModel.IMAGINED


@pytest.fixture(scope="module")
def store(dataset_root: Path) -> EpisodeStore:
    reader = DatasetReader.open(DatasetConfig(root=str(dataset_root)))
    return EpisodeStore.load([reader], "train", ReturnConfig(steps=5))


class _Counting(CountingModel):
    """Counts through whole sequences, too."""

    def advance(self, carry: Carry, action: Tensor, is_first: Tensor) -> Tensor:
        h = carry.h.masked_fill(is_first[:, None], 0.0).clone()
        h[:, COUNT] += 1.0
        return h


def _collect(model: WorldModel, store: EpisodeStore, ahead: int) -> Rows:
    return collect_rows(model, _whole(store), ahead, torch.Generator().manual_seed(0))


def _whole(store: EpisodeStore, mirror: Mirrored = "none") -> Iterator[Batch]:
    return whole_episodes(store, torch.device("cpu"), mirror)


def test_every_row_with_a_complete_return_is_collected_once(store: EpisodeStore) -> None:
    model = _Counting()
    rows = _collect(model, store, ahead=0)
    assert len(rows.target) == store.mc_valid.sum()
    expected = torch.from_numpy(store.mc_return[store.mc_valid])
    torch.testing.assert_close(rows.target.sort().values, expected.sort().values)
    assert not rows.h[:, IMAGINED].any()
    mirrored = collect_rows(model, _whole(store, mirror="all"), 0, torch.Generator().manual_seed(0))
    assert len(mirrored.target) == 2 * len(rows.target)


def test_states_are_imagined_as_far_as_the_planner_looks(store: EpisodeStore) -> None:
    """A state k ticks ahead of row t has the action of row t + k and the return of row t + k."""
    rows = _collect(_Counting(), store, ahead=3)
    ahead, tick = rows.h[:, IMAGINED], rows.h[:, COUNT] - 1
    assert set(ahead.tolist()) == {0.0, 1.0, 2.0, 3.0}
    at = (tick + ahead).long()
    index = {
        (t, round(float(a), 3)): i
        for t, i, a in (
            (int(i - first), int(i), store.action[i, 0])
            for first, length in zip(store.start, store.length, strict=True)
            for i in range(first, first + length)
        )
    }
    matched = 0
    for t, action, target, led, k in zip(at, rows.action, rows.target, rows.z, ahead, strict=True):
        i = index.get((int(t), round(float(action[0]), 3)))
        if i is None:
            continue  # rounded to half precision across the third digit
        matched += 1
        assert store.mc_return[i] == pytest.approx(float(target))
        if k > 0:
            before = torch.from_numpy(store.action[i - 1])
            torch.testing.assert_close(led[:7].float(), before, atol=1e-3, rtol=0)
    assert matched > 0.5 * len(rows.target)


def _error(model: WorldModel, rows: Rows) -> float:
    carry = Carry(rows.h.float(), rows.z.float())
    with torch.no_grad():
        return float(
            (model.standardised_value(carry, rows.action.float()) - rows.target).square().mean()
        )


def test_the_fit_improves_q_and_touches_nothing_else(store: EpisodeStore) -> None:
    model = toy_model()
    set_normalisation(model, store)
    before = {k: v.clone() for k, v in model.state_dict().items()}
    rows = _collect(model, store, ahead=3)
    start = _error(model, rows)
    fit_value(
        model, _whole(store), ValueFitConfig(steps=60, passes=0.0, told_steps=60, rows=64), seed=0
    )
    assert _error(model, rows) < 0.5 * start
    changed = {k for k, v in model.state_dict().items() if not torch.equal(v, before[k])}
    assert changed
    heads = {"value_head", "more_value_heads", "passing_value_head"}
    assert {name.split(".")[0] for name in changed} == heads


def test_what_an_action_earns_is_not_credited_to_the_state_that_goes_with_it() -> None:
    """Return = -(a - p)^2 with p on its way, and a state that holds a itself: Q must use a."""
    model = toy_model()
    rng = torch.Generator().manual_seed(0)
    count, config = 4096, model.config
    h = torch.randn(count, config.hidden, generator=rng)
    z = torch.randn(count, config.latent, generator=rng)
    action = torch.rand((count, 7), generator=rng) * 2 - 1
    h[:, 0] = action[:, 0]
    with torch.no_grad():
        told = model.passing(Carry(h, z))
    place = told[:, 1]
    target = -((action[:, 0] - place) ** 2)
    standardised = (target - target.mean()) / target.std()
    rows = Rows(h, z, told, action, standardised, torch.zeros(count))
    _fit_heads(model, rows, ValueFitConfig(steps=300, told_steps=300, rows=512, lr=3e-3), rng)
    with torch.no_grad():
        good, bad = action.clone(), action.clone()
        good[:, 0], bad[:, 0] = place, torch.where(place > 0, -1.0, 1.0)
        better = model.standardised_value(Carry(h, z), good) > model.standardised_value(
            Carry(h, z), bad
        )
    assert better.float().mean() > 0.95


@pytest.mark.parametrize("steps", [0, 100])
def test_the_part_told_of_flights_may_stay_silent(steps: int) -> None:
    """Then the other part learns all of Q; else only what the first leaves unexplained."""
    model = toy_model()
    rng = torch.Generator().manual_seed(0)
    count, config = 2048, model.config
    h = torch.randn(count, config.hidden, generator=rng)
    z = torch.randn(count, config.latent, generator=rng)
    action = torch.rand((count, 7), generator=rng) * 2 - 1
    told = torch.zeros(count, 4)
    target = h[:, 0] = action[:, 0]
    rows = Rows(h, z, told, action, target, torch.zeros(count))
    _fit_heads(model, rows, ValueFitConfig(steps=100, told_steps=steps, rows=512, lr=3e-3), rng)
    passing = model.q_heads.passing
    assert passing is not None
    with torch.no_grad():
        said = passing(told, action)
        q = model.value_head(h, z, action)[:, 0]
    assert bool((said == 0).all()) == (steps == 0)
    learned = said[:, 0] if steps else q
    assert (learned - target).square().mean() < 0.2 * target.var()


@pytest.mark.parametrize("kind", ["mse", "two_hot"])
def test_the_part_told_of_flights_may_judge_nothing_but_flights(kind: ValueLoss) -> None:
    """Where something comes it says what the action is worth, elsewhere nothing."""
    model = toy_model(replace(PRESETS["debug"], value_loss=kind))
    rng = torch.Generator().manual_seed(0)
    count, config = 2048, model.config
    h = torch.randn(count, config.hidden, generator=rng)
    z = torch.randn(count, config.latent, generator=rng)
    action = torch.rand((count, 7), generator=rng) * 2 - 1
    told = torch.rand((count, 4), generator=rng) * 0.5 + 0.5
    coming = torch.rand(count, generator=rng) < 0.5
    told[~coming] = 0.0
    rows = Rows(h, z, told, action, 2 * action[:, 0], torch.zeros(count))

    def spread(where: ToldWhere) -> list[float]:
        fit = ValueFitConfig(steps=1, passes=0.0, told_steps=300, told_where=where, rows=512)
        _fit_heads(model, rows, fit, torch.Generator().manual_seed(0))
        passing = model.q_heads.passing
        assert passing is not None
        with torch.no_grad():
            said = value.read(passing(told, action), kind)
        return [float(said[some].std() / rows.target[some].std()) for some in (coming, ~coming)]

    flights, others = spread("coming")
    assert flights > 0.6
    assert others < 0.2
    assert min(spread("everywhere")) > 0.6


def test_a_seed_repeats_the_fit_and_no_steps_leave_the_model_alone(store: EpisodeStore) -> None:
    def fitted(steps: int, seed: int) -> dict[str, Tensor]:
        model = toy_model()
        fit_value(
            model,
            _whole(store, mirror="all"),
            ValueFitConfig(steps, passes=0.0, told_steps=steps, rows=16),
            seed,
        )
        return model.state_dict()

    def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
        return all(torch.equal(a[k], b[k]) for k in a)

    assert same(fitted(3, 0), fitted(3, 0))
    assert not same(fitted(3, 0), fitted(3, 1))
    assert same(fitted(0, 0), dict(toy_model().state_dict()))


def test_many_rows_are_gone_over_as_often_as_few() -> None:
    config = ValueFitConfig(steps=600, passes=2.0, rows=1024)
    assert config.steps_over(300_000) == 600
    assert config.steps_over(1_400_000) == 2735


@pytest.mark.parametrize("told", [[], [5]])
def test_the_fit_takes_the_steps_that_its_rows_ask_for(
    store: EpisodeStore, told: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[int] = []

    def counted(total: range, **options: object) -> range:
        taken.append(len(total))
        return total

    monkeypatch.setattr(value_fit, "tqdm", counted)
    model = toy_model()
    count = len(_collect(model, store, ahead=3).target)
    config = ValueFitConfig(3, passes=2.0, told_steps=sum(told), rows=16)
    fit_value(model, _whole(store), config, seed=0)
    heads = len(model.q_heads.states)
    assert taken == told + heads * [math.ceil(2 * count / 16)]


@pytest.mark.parametrize(
    "wrong",
    [
        {"steps": -1},
        {"rows": 0},
        {"told_rows": 0},
        {"told_steps": -1},
        {"passes": -1.0},
        {"passes": math.inf},
        {"passes": math.nan},
        {"imagined_steps": -1},
        {"dropout": 1.0},
    ],
)
def test_what_cannot_be_fitted_is_refused_at_once(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=f"^{next(iter(wrong))}=.*: expected"):
        ValueFitConfig(**wrong)


def test_a_batch_of_the_stream_becomes_the_models_tensors(store: EpisodeStore) -> None:
    arrays = next(SequenceStream(store, StreamConfig(batch_size=3, length=6)))
    batch = to_tensors(arrays, torch.device("cpu"))
    for name in Batch._fields:
        tensor = getattr(batch, name)
        assert tensor.shape == arrays[name].shape
        torch.testing.assert_close(tensor.double(), torch.from_numpy(arrays[name].astype(float)))


def test_whole_episodes_are_whole_and_in_their_order(store: EpisodeStore) -> None:
    (batch,) = whole_episodes(store, torch.device("cpu"), limit=3)
    assert batch.is_first[:, 0].all()
    assert batch.is_first.sum() == 3
    assert batch.valid.sum(1).tolist() == store.length[:3].tolist()
    plain, mirrored = whole_episodes(store, torch.device("cpu"), mirror="all", limit=2)
    torch.testing.assert_close(mirrored.depth, plain.depth.flip(-1))
    everything = sum(int(b.valid.sum()) for b in whole_episodes(store, torch.device("cpu")))
    assert everything == store.num_frames


def test_mirror_images_may_be_those_of_flights_only(store: EpisodeStore) -> None:
    passing = np.zeros_like(store.passing)
    passing[store.start[3] - 1, 3] = 1.0  # something flies on the last row of the third episode
    store = replace(store, passing=passing)
    plain, mirrored = whole_episodes(store, torch.device("cpu"), "flights")
    assert len(plain.valid) == len(store.length)
    third = plain.depth[2:3, : store.length[2]]
    torch.testing.assert_close(mirrored.depth, third.flip(-1))
    assert not len(mirrored_episodes(store, "flights", 2))
    assert mirrored_episodes(store, "all", 2).tolist() == [0, 1]


def test_whole_episodes_are_padded_to_the_longest_beside_them(
    store: EpisodeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "EPISODES_AT_ONCE", 1)
    found = [batch.valid for batch in whole_episodes(store, torch.device("cpu"))]
    assert [valid.shape[1] for valid in found] == store.length.tolist()
    assert len(set(store.length.tolist())) > 1
    assert all(bool(valid.all()) for valid in found)
