"""Batches from episodes in memory, and batches prefetched in a thread."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    Episode,
    EpisodeIndex,
    EpisodeStore,
    InMemorySampler,
    Provenance,
    ReturnConfig,
    SamplerConfig,
    ShuffleConfig,
    StreamingSampler,
)
from egovcp.data import index as index_module
from egovcp.data.index import in_split
from egovcp.data.privileged import privileged_features
from egovcp.data.samplers import PrefetchIterator
from egovcp.errors import DataError, UsageError
from egovcp.robot_spec import G1


@pytest.fixture(scope="module")
def store(reader: DatasetReader) -> EpisodeStore:
    return EpisodeStore.load([reader], returns=ReturnConfig(steps=5))


def _config(**changes: object) -> SamplerConfig:
    return SamplerConfig(**{"batch_size": 8, "length": 6, "mirror": False, **changes})


def _same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def test_every_row_of_a_window_is_the_row_of_its_episode(
    store: EpisodeStore, episodes: list[Episode]
) -> None:
    stream = InMemorySampler(store, _config())
    for batch in (next(stream) for _ in range(20)):
        for b, episode in enumerate(batch["episode"]):
            t, source = batch["t"][b], episodes[episode]
            valid = batch["valid"][b]
            np.testing.assert_array_equal(np.diff(t[valid]), 1)
            for name in ("depth", "state", "action", "reward"):
                rows = getattr(source, name)[t[valid]]
                np.testing.assert_array_equal(batch[name][b][valid], rows)
            features = privileged_features(source.object, source.reward_terms)
            np.testing.assert_array_equal(batch["privileged"][b][valid], features[t[valid]])
            np.testing.assert_array_equal(batch["is_first"][b], (t == 0) & valid)
            fell = source.terminated & (t == len(source) - 1) & valid
            np.testing.assert_array_equal(batch["terminal_next"][b], fell)
            assert valid.sum() == min(6, len(source))
            assert not batch["mc_valid"][b][~valid].any()


def test_prev_action_is_the_action_before_and_neutral_at_the_start(
    store: EpisodeStore, episodes: list[Episode]
) -> None:
    for first, length, episode in zip(store.start, store.length, episodes, strict=True):
        before = store.prev_action[first : first + length]
        assert not before[0].any()
        np.testing.assert_array_equal(before[1:], episode.action[:-1])


def test_every_row_is_visited(store: EpisodeStore) -> None:
    stream = InMemorySampler(store, _config())
    seen = set()
    for batch in (next(stream) for _ in range(150)):
        rows = store.start[batch["episode"]][:, None] + batch["t"]
        seen.update(rows[batch["valid"]].tolist())
    assert seen == set(range(store.num_frames))


def test_a_seed_gives_the_same_batches_and_another_seed_others(store: EpisodeStore) -> None:
    one, two = (InMemorySampler(store, _config(mirror=True)) for _ in range(2))
    other = InMemorySampler(store, _config(mirror=True, seed=1))
    first = next(one)
    assert _same(first, next(two))
    assert not _same(first, next(other))


def test_resuming_continues_with_exactly_the_next_batches(store: EpisodeStore) -> None:
    config = _config(mirror=True, burn_in=2)
    straight = InMemorySampler(store, config)
    stopped = InMemorySampler(store, config)
    for _ in range(7):
        next(straight), next(stopped)
    state = json.loads(json.dumps(stopped.state_dict()))
    resumed = InMemorySampler(store, config).load_state_dict(state)
    for _ in range(5):
        assert _same(next(straight), next(resumed))


def test_resuming_with_other_data_or_settings_is_refused(
    store: EpisodeStore, reader: DatasetReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_module, "HELDOUT_FRACTION", 0.5)
    state = InMemorySampler(store, _config()).state_dict()
    with pytest.raises(UsageError, match="length 6 -> 7; give the options of the run"):
        InMemorySampler(store, _config(length=7)).load_state_dict(state)
    fewer = EpisodeStore.load([reader], "train")
    with pytest.raises(DataError, match="episodes have changed"):
        InMemorySampler(fewer, _config()).load_state_dict(state)


def test_burn_in_rows_count_only_at_the_start_of_an_episode(store: EpisodeStore) -> None:
    stream = InMemorySampler(store, _config(burn_in=3))
    for batch in (next(stream) for _ in range(20)):
        assert batch["valid"].shape == (8, 9)
        inside = batch["t"][:, 0] > 0
        assert not batch["valid"][inside, :3].any()
        assert batch["valid"][~inside, 0].all()


def test_mirrored_windows_are_reflections(store: EpisodeStore) -> None:
    plain = InMemorySampler(store, _config(batch_size=64))
    mirrored = InMemorySampler(store, _config(batch_size=64, mirror=True))
    a, b = next(plain), next(mirrored)
    flipped = (a["depth"] != b["depth"]).any(axis=(1, 2, 3))
    assert 10 < flipped.sum() < 54
    np.testing.assert_array_equal(b["depth"][flipped], a["depth"][flipped][..., ::-1])
    np.testing.assert_array_equal(b["state"][flipped], G1.mirrored_state(a["state"][flipped]))
    for name in ("action", "prev_action"):
        np.testing.assert_array_equal(b[name][flipped], G1.mirrored_action(a[name][flipped]))
    np.testing.assert_array_equal(a["mc_return"], b["mc_return"])


def test_the_splits_partition_the_episodes(
    reader: DatasetReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_module, "HELDOUT_FRACTION", 0.5)
    train, heldout = (EpisodeStore.load([reader], split) for split in ("train", "heldout"))
    everything = EpisodeStore.load([reader], "all")
    assert not set(train.identities) & set(heldout.identities)
    assert set(train.identities) | set(heldout.identities) == set(everything.identities)


def test_the_held_out_share_is_near_its_fraction_and_ignores_order() -> None:
    names = [f"ball/0/{i}" for i in range(20_000)]
    heldout = in_split(names, "heldout")
    assert 850 < sum(heldout) < 1150
    assert in_split(names[::-1], "heldout") == heldout[::-1]
    assert in_split(names[:10_000], "heldout") == heldout[:10_000]
    assert in_split(names, "train") == [not h for h in heldout]


@pytest.mark.parametrize("count", [2, 3, 10])
def test_a_small_dataset_has_both_training_and_held_out_episodes(count: int) -> None:
    names = [f"ball/3/{i}" for i in range(count)]
    heldout, train = in_split(names, "heldout"), in_split(names, "train")
    assert any(heldout)
    assert any(train)
    assert [not h for h in heldout] == train


def test_datasets_of_different_controllers_do_not_mix(
    tmp_path: Path, reader: DatasetReader, episodes: list[Episode]
) -> None:
    with DatasetWriter(tmp_path / "other", Provenance("walker-2")) as writer:
        writer.add(episodes[0])
    other = DatasetReader.open(DatasetConfig(root=str(tmp_path / "other")))
    with pytest.raises(
        DataError, match=r"controller_id walker-2.*stance-1.*the same controller_id"
    ):
        EpisodeStore.load([reader, other])
    assert EpisodeStore.load([other, other]).num_frames == 24


@pytest.mark.parametrize("changes", [{"length": 0}, {"batch_size": 0}, {"burn_in": -1}])
def test_stream_refuses_settings_out_of_bounds(
    store: EpisodeStore, changes: dict[str, object]
) -> None:
    with pytest.raises(UsageError, match="expected"):
        InMemorySampler(store, _config(**changes))


def test_an_unknown_split_is_refused(reader: DatasetReader) -> None:
    with pytest.raises(UsageError, match="did you mean 'heldout'"):
        EpisodeStore.load([reader], "held_out")


type MakeStream = Callable[[], StreamingSampler]


@pytest.fixture
def make_stream(reader: DatasetReader) -> MakeStream:
    config = SamplerConfig(batch_size=4, length=4)
    index = EpisodeIndex.of([reader])
    return lambda: StreamingSampler(index, config, shuffle=ShuffleConfig(3))


def test_prefetching_from_memory_keeps_the_batches(reader: DatasetReader) -> None:
    store, config = EpisodeStore.load([reader]), SamplerConfig(batch_size=4, length=4)
    plain, ahead = InMemorySampler(store, config), PrefetchIterator(InMemorySampler(store, config))
    for _ in range(5):
        assert ahead.state_dict() == plain.state_dict()
        expected, found = next(plain), next(ahead)
        assert all(np.array_equal(expected[k], found[k]) for k in expected)


def test_prefetching_keeps_batches_and_states(make_stream: MakeStream) -> None:
    plain, ahead = make_stream(), PrefetchIterator(make_stream())
    for _ in range(10):
        assert ahead.state_dict() == plain.state_dict()
        expected, found = next(plain), next(ahead)
        assert all(np.array_equal(expected[k], found[k]) for k in expected)


def test_loading_a_state_drops_the_prefetched_batch(make_stream: MakeStream) -> None:
    plain, ahead = make_stream(), PrefetchIterator(make_stream())
    state = json.loads(json.dumps(ahead.state_dict()))
    first = next(plain)
    for _ in range(3):
        next(ahead)
        ahead.load_state_dict(state)
        assert ahead.state_dict() == state
        assert np.array_equal(next(ahead)["state"], first["state"])


def test_errors_of_the_thread_are_raised_by_next(
    make_stream: MakeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(index: EpisodeIndex, episode: int) -> None:
        raise DataError(f"episode {episode} is damaged")

    monkeypatch.setattr(EpisodeIndex, "read_unchecked", damaged)
    ahead = PrefetchIterator(make_stream())
    for _ in range(2):
        with pytest.raises(DataError, match="is damaged"):
            next(ahead)


_ENDS_DURING_A_DOWNLOAD = """
import threading
from egovcp.data.samplers import PrefetchIterator

class Sampler:
    batches = 0

    def state_dict(self):
        return {}

    def __next__(self):
        if self.batches:
            threading.Event().wait()  # as for a file of an unreachable Hub
        self.batches += 1

next(PrefetchIterator(Sampler()))
"""


def test_a_process_does_not_wait_for_a_prefetched_batch_at_its_end() -> None:
    subprocess.run([sys.executable, "-c", _ENDS_DURING_A_DOWNLOAD], check=True, timeout=30)
