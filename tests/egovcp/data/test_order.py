"""Several datasets in one stream: shares, repeatability, resuming."""

import json
from collections import Counter

import numpy as np
import pytest

from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    EpisodeStore,
    InMemorySampler,
    Mix,
    Provenance,
    SamplerConfig,
)
from egovcp.errors import UsageError

from .conftest import MakeEpisode

CONFIG = SamplerConfig(batch_size=32, length=4, mirror=True)


@pytest.fixture(scope="module")
def both(
    reader: DatasetReader, make_episode: MakeEpisode, tmp_path_factory: pytest.TempPathFactory
) -> EpisodeStore:
    """The six episodes of ball and wall, and four of arch from another dataset."""
    root = tmp_path_factory.mktemp("mix") / "four"
    with DatasetWriter(root, Provenance("stance-1", seed=5, command="collect")) as writer:
        for number in range(4):
            writer.add(make_episode(number, 15, task="arch", seed=5))
    return EpisodeStore.load([reader, DatasetReader.open(DatasetConfig(root=str(root)))])


def _windows(store: EpisodeStore, mix: Mix, config: SamplerConfig = CONFIG) -> np.ndarray:
    stream = InMemorySampler(store, config, mix)
    return np.concatenate([next(stream)["episode"] for _ in range(100)])


def test_a_dataset_is_drawn_by_its_weight(both: EpisodeStore) -> None:
    drawn = Counter(both.dataset[_windows(both, Mix(datasets=(3.0, 1.0)))].tolist())
    assert drawn[0] / drawn.total() == pytest.approx(0.75, abs=0.03)


def test_a_task_weight_multiplies_its_share(both: EpisodeStore) -> None:
    tasks = np.array(both.tasks)
    frames = {task: both.length[tasks == task].sum() for task in set(both.tasks)}
    drawn = Counter(tasks[_windows(both, Mix(tasks={"wall": 3.0, "arch": 0.0}))].tolist())
    assert drawn["arch"] == 0
    odds = 3 * frames["wall"] / frames["ball"]
    assert drawn["wall"] / drawn["ball"] == pytest.approx(odds, rel=0.15)


def test_without_weights_all_frames_are_equally_likely(both: EpisodeStore) -> None:
    drawn = np.bincount(_windows(both, Mix()), minlength=len(both.length))
    np.testing.assert_allclose(drawn / drawn.sum(), both.length / both.num_frames, atol=0.03)


def test_a_mixed_stream_resumes_with_exactly_the_next_batches(both: EpisodeStore) -> None:
    mix = Mix((1.0, 2.0), {"ball": 2.0})
    straight, stopped = (InMemorySampler(both, CONFIG, mix) for _ in range(2))
    for _ in range(3):  # three times stopped and resumed
        for _ in range(4):
            expected, found = next(straight), next(stopped)
            assert all(np.array_equal(expected[k], found[k]) for k in expected)
        state = json.loads(json.dumps(stopped.state_dict()))
        stopped = InMemorySampler(both, CONFIG, mix).load_state_dict(state)


def test_resuming_with_other_weights_is_refused(both: EpisodeStore) -> None:
    state = InMemorySampler(both, CONFIG, Mix((1.0, 2.0))).state_dict()
    with pytest.raises(UsageError, match=r"datasets \[1.0, 2.0\] -> \[2.0, 2.0\]"):
        InMemorySampler(both, CONFIG, Mix((2.0, 2.0))).load_state_dict(state)


@pytest.mark.parametrize(
    ("mix", "message"),
    [
        (Mix(datasets=(1.0,)), "1 weights for 2 datasets"),
        (Mix(datasets=(1.0, -1.0)), "--datasets: a weight of -1.0"),
        (Mix(datasets=(0.0, 0.0)), "no episode to draw"),
        (Mix(tasks={"wal": 1.0}), "training episode is of task 'wal'; did you mean 'wall'"),
        (Mix(tasks={"ball": float("nan")}), "--sampling.tasks: a weight of nan"),
    ],
)
def test_invalid_weights_are_refused(both: EpisodeStore, mix: Mix, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        InMemorySampler(both, CONFIG, mix)
