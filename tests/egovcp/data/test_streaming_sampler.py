"""Batches from a few episodes at a time: the same contract, bounded, resumable."""

import json
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    EpisodeIndex,
    EpisodeStore,
    InMemorySampler,
    Mix,
    Provenance,
    ReturnConfig,
    SamplerConfig,
    ShuffleConfig,
    StreamingSampler,
)
from egovcp.data import index as index_module
from egovcp.errors import DataError, UsageError

from .conftest import MakeEpisode

RETURNS = ReturnConfig(steps=5)
FEW = ShuffleConfig(episodes=3)

type MakeIndex = Callable[..., EpisodeIndex]


@pytest.fixture(scope="module", autouse=True)
def _more_held_out_episodes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(index_module, "HELDOUT_FRACTION", 0.2)
        yield


@pytest.fixture(scope="module")
def make_index(make_episode: MakeEpisode, tmp_path_factory: pytest.TempPathFactory) -> MakeIndex:
    """An index of new datasets with so many episodes, of 9 to 14 rows; one file per dataset."""

    def build(*counts: int, split: str = "train", task: str = "ball") -> EpisodeIndex:
        readers = []
        for number, count in enumerate(counts):
            root = tmp_path_factory.mktemp("bounded") / "dataset"
            with DatasetWriter(root, Provenance("stance-1", seed=0, command="collect")) as writer:
                for i in range(count):
                    writer.add(make_episode(i, 9 + i % 6, task=task, seed=number))
            readers.append(DatasetReader.open(DatasetConfig(root=str(root))))
        return EpisodeIndex.of(readers, split)

    return build


@pytest.fixture(scope="module")
def six(reader: DatasetReader) -> EpisodeIndex:
    return EpisodeIndex.of([reader])


def _config(**changes: object) -> SamplerConfig:
    return SamplerConfig(**{"batch_size": 8, "length": 4, "mirror": False, **changes})


def _same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def test_batches_have_the_rows_of_the_in_memory_sampler(
    six: EpisodeIndex, reader: DatasetReader
) -> None:
    """Same keys, shapes and types; every valid row is that of its episode, targets included."""
    store = EpisodeStore.load([reader], returns=RETURNS)
    pattern = next(InMemorySampler(store, _config(burn_in=2)))
    stream = StreamingSampler(six, _config(burn_in=2), shuffle=FEW, returns=RETURNS)
    for batch in (next(stream) for _ in range(30)):
        assert {k: (v.shape, v.dtype) for k, v in batch.items()} == {
            k: (v.shape, v.dtype) for k, v in pattern.items()
        }
        rows = store.start[batch["episode"]][:, None] + batch["t"]
        inside = rows < (store.start + store.length)[batch["episode"]][:, None]
        assert inside.all()
        for name in set(batch) - {"episode", "t", "valid", "is_first"}:
            np.testing.assert_array_equal(
                batch[name][batch["valid"]], getattr(store, name)[rows][batch["valid"]]
            )
        np.testing.assert_array_equal(batch["is_first"], (batch["t"] == 0) & batch["is_first"])
        assert not batch["valid"][batch["t"][:, 0] > 0, :2].any()


def test_every_row_is_visited(six: EpisodeIndex) -> None:
    stream = StreamingSampler(six, _config(), shuffle=FEW)
    seen = set()
    for batch in (next(stream) for _ in range(200)):
        pairs = zip(np.repeat(batch["episode"], 4), batch["t"].ravel(), strict=True)
        seen |= {pair for pair, valid in zip(pairs, batch["valid"].ravel(), strict=True) if valid}
    assert len(seen) == six.num_frames


def test_episodes_are_drawn_in_proportion_to_their_frames(six: EpisodeIndex) -> None:
    stream = StreamingSampler(six, _config(batch_size=32), shuffle=FEW)
    drawn = np.bincount(
        np.concatenate([next(stream)["episode"] for _ in range(150)]), minlength=len(six)
    )
    np.testing.assert_allclose(drawn / drawn.sum(), six.length / six.num_frames, atol=0.02)


@pytest.mark.parametrize("batch_size", [1, 8, pytest.param(50, marks=pytest.mark.slow)])
def test_resuming_any_number_of_times_continues_with_exactly_the_next_batches(
    six: EpisodeIndex, batch_size: int
) -> None:
    """Across many epochs: six episodes yield about 16 windows in each."""
    config = _config(batch_size=batch_size, mirror=True, burn_in=1)

    def make() -> StreamingSampler:
        mix = Mix(tasks={"wall": 2.0})
        return StreamingSampler(six, config, mix, FEW, returns=RETURNS)

    straight, stopped = make(), make()
    for _ in range(8):
        for _ in range(5):
            assert _same(next(straight), next(stopped))
        stopped = make().load_state_dict(json.loads(json.dumps(stopped.state_dict())))
    assert min(straight.state_dict()["order"]["epoch"]) >= 1


def test_a_seed_repeats_the_batches_and_another_gives_others(six: EpisodeIndex) -> None:
    one, two = (next(StreamingSampler(six, _config(), shuffle=FEW)) for _ in range(2))
    assert _same(one, two)
    assert not _same(one, next(StreamingSampler(six, _config(seed=1), shuffle=FEW)))


def test_resuming_with_other_options_or_data_is_refused(
    six: EpisodeIndex, reader: DatasetReader
) -> None:
    state = StreamingSampler(six, _config(), shuffle=FEW).state_dict()
    with pytest.raises(UsageError, match="episodes 3 -> 4"):
        StreamingSampler(six, _config(), shuffle=ShuffleConfig(4)).load_state_dict(state)
    with pytest.raises(DataError, match="episodes have changed"):
        StreamingSampler(six.select(np.arange(5)), _config(), shuffle=FEW).load_state_dict(state)
    store = EpisodeStore.load([reader])
    with pytest.raises(UsageError, match="has streamed its data"):
        InMemorySampler(store, _config()).load_state_dict(state)
    with pytest.raises(UsageError, match="had its data in memory"):
        StreamingSampler(six, _config()).load_state_dict(
            InMemorySampler(store, _config()).state_dict()
        )


# --- several datasets ------------------------------------------------------------------------
def test_datasets_are_drawn_by_weight(make_index: MakeIndex) -> None:
    index = make_index(20, 6)
    stream = StreamingSampler(index, _config(batch_size=32), Mix((1.0, 3.0)), ShuffleConfig(8))
    episodes = np.concatenate([next(stream)["episode"] for _ in range(100)])
    drawn = Counter(index.dataset[episodes].tolist())
    assert drawn[1] / drawn.total() == pytest.approx(0.75, abs=0.04)


def test_held_out_episodes_are_never_read(
    make_index: MakeIndex, monkeypatch: pytest.MonkeyPatch
) -> None:
    index = make_index(20)
    heldout = set(EpisodeIndex.of(index.readers, "heldout").identities)
    assert len(heldout) > 1
    read = set()
    read_unchecked = EpisodeIndex.read_unchecked

    def noted(self: EpisodeIndex, episode: int) -> object:
        read.add(self.identities[episode])
        return read_unchecked(self, episode)

    monkeypatch.setattr(EpisodeIndex, "read_unchecked", noted)
    stream = StreamingSampler(index, _config(), shuffle=FEW)
    for _ in range(40):
        next(stream)
    assert read == set(index.identities)
    assert not read & heldout


# --- memory -----------------------------------------------------------------------------------
def _peak(index: EpisodeIndex) -> int:
    """Bytes, of arrays, while batches are drawn."""
    len(index.length)
    tracemalloc.start()
    stream = StreamingSampler(index, _config(), shuffle=FEW)
    for _ in range(40):
        next(stream)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_number_of_episodes(make_index: MakeIndex) -> None:
    few, many = make_index(12), make_index(120)
    _peak(few)  # imports, caches
    assert _peak(many) < 1.1 * _peak(few)


@pytest.mark.parametrize("checked", [True, False])
def test_unchecked_episodes_are_compared_with_their_digest(
    make_index: MakeIndex, checked: bool
) -> None:
    root = make_index(6).readers[0].root
    path = root / "meta" / "collection.json"
    collection = json.loads(path.read_text())
    collection["episodes"][4]["sha256"] = "0" * 64
    path.write_text(json.dumps(collection))
    index = EpisodeIndex.of([DatasetReader.open(DatasetConfig(root=str(root)))])
    stream = StreamingSampler(index, _config(), shuffle=ShuffleConfig(2), checked=checked)
    drawn: list[int] = []

    def draw() -> None:
        for batch in islice(stream, 40):
            drawn.extend(batch["episode"])

    if checked:
        draw()
        assert 4 in drawn
    else:
        with pytest.raises(DataError, match=r"episode 4.*differs from what was collected"):
            draw()
        assert 4 not in drawn


def test_a_file_that_is_damaged_later_is_named(make_index: MakeIndex) -> None:
    index = make_index(20)
    stream = StreamingSampler(index, _config(), shuffle=FEW)
    next(stream)
    path: Path = index.files[0]
    index.readers[0]._open_file.cache_clear()
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match=path.name):
        list(islice(stream, 40))


@pytest.mark.parametrize("shuffle", [ShuffleConfig(0), ShuffleConfig(3, 1e-9)])
def test_invalid_window_options_are_refused(six: EpisodeIndex, shuffle: ShuffleConfig) -> None:
    with pytest.raises(UsageError, match=r"shuffle\.\w+=(0|1e-0?9): expected"):
        StreamingSampler(six, _config(), shuffle=shuffle)
