"""A batch made ahead changes neither the batches nor where a stream stands."""

import json
from collections.abc import Callable

import numpy as np
import pytest

from egovcp.data import (
    BoundedStream,
    DatasetReader,
    EpisodeIndex,
    EpisodeStore,
    SequenceStream,
    ShuffleConfig,
    StreamConfig,
)
from egovcp.data.ahead import Ahead
from egovcp.errors import DataError

type MakeStream = Callable[[], BoundedStream]


@pytest.fixture
def make_stream(reader: DatasetReader) -> MakeStream:
    config = StreamConfig(batch_size=4, length=4)
    index = EpisodeIndex.of([reader])
    return lambda: BoundedStream(index, config, shuffle=ShuffleConfig(3))


def test_batches_from_memory_are_the_same_too(reader: DatasetReader) -> None:
    store, config = EpisodeStore.load([reader]), StreamConfig(batch_size=4, length=4)
    plain, ahead = SequenceStream(store, config), Ahead(SequenceStream(store, config))
    for _ in range(5):
        assert ahead.state_dict() == plain.state_dict()
        expected, found = next(plain), next(ahead)
        assert all(np.array_equal(expected[k], found[k]) for k in expected)


def test_batches_and_states_are_those_of_the_stream(make_stream: MakeStream) -> None:
    plain, ahead = make_stream(), Ahead(make_stream())
    for _ in range(10):
        assert ahead.state_dict() == plain.state_dict()
        expected, found = next(plain), next(ahead)
        assert all(np.array_equal(expected[k], found[k]) for k in expected)


def test_a_state_is_taken_up_whatever_was_made_ahead(make_stream: MakeStream) -> None:
    plain, ahead = make_stream(), Ahead(make_stream())
    state = json.loads(json.dumps(ahead.state_dict()))
    first = next(plain)
    for _ in range(3):
        next(ahead)
        ahead.load_state_dict(state)
        assert ahead.state_dict() == state
        assert np.array_equal(next(ahead)["state"], first["state"])


def test_what_goes_wrong_in_the_thread_is_told_to_the_taker(
    make_stream: MakeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(index: EpisodeIndex, episode: int) -> None:
        raise DataError(f"episode {episode} is damaged")

    monkeypatch.setattr(EpisodeIndex, "read_again", damaged)
    ahead = Ahead(make_stream())
    for _ in range(2):
        with pytest.raises(DataError, match="is damaged"):
            next(ahead)
