"""Statistics of datasets with known content."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egovcp.data import DatasetConfig, DatasetReader, EpisodeStore, ReturnConfig
from egovcp.spec import ACTION_BOX, ACTION_NAMES, REWARD_TERMS, reflect
from egovcp_collect.dataset.figures import _SUCCESS, _event_colour
from egovcp_collect.dataset.statistics import (
    GRID_CELLS,
    HISTOGRAM_BINS,
    ActionStatistics,
    DatasetStatistics,
    compute_statistics,
    drawn_parameters,
    events_ahead,
)
from egovcp_collect.dataset.task_data import read_rows, sample_episodes

from .episodes import LENGTH, make_episode, three_balls, write_episodes

RETURNS = ReturnConfig(steps=10)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> DatasetReader:
    """Three balls and, between them, an arch."""
    first, *others = three_balls()
    arch = make_episode(3, {5: -0.1}, task="arch", terms=("hit",), length=30, time_limit=30)
    return write_episodes(tmp_path_factory.mktemp("data") / "mixed", [first, arch, *others])


@pytest.fixture(scope="module")
def found(reader: DatasetReader) -> DatasetStatistics:
    return compute_statistics(reader, RETURNS)


def test_tasks_share_the_steps(found: DatasetStatistics, reader: DatasetReader) -> None:
    assert [task.task for task in found.tasks] == ["ball", "arch"]
    assert sum(task.frames for task in found.tasks) == reader.num_frames
    assert sum(task.frame_share for task in found.tasks) == pytest.approx(1.0)


def test_returns_equal_those_of_the_training_store(reader: DatasetReader) -> None:
    store = EpisodeStore.load([reader], returns=RETURNS)
    for rows in read_rows(reader, RETURNS):
        mine = np.repeat([task == rows.task for task in store.tasks], store.length)
        np.testing.assert_array_equal(rows.mc_return, store.mc_return[mine])
        np.testing.assert_array_equal(rows.mc_valid, store.mc_valid[mine])
        np.testing.assert_array_equal(rows.action, store.action[mine])


def test_events_ahead_equal_a_search_of_each_window(reader: DatasetReader) -> None:
    for rows in read_rows(reader, RETURNS):
        success, failure = events_ahead(rows, RETURNS.steps)
        for first, length in zip(rows.start, rows.length, strict=True):
            span = slice(first, first + length)
            reward = rows.reward[span]
            windows = [reward[t : t + RETURNS.steps] for t in range(len(reward))]
            assert success[span].tolist() == [bool((w > 0).any()) for w in windows]
            assert failure[span].tolist() == [bool((w < 0).any()) for w in windows]


def test_events_ahead_come_from_recorded_terms_not_from_action_costs(tmp_path: Path) -> None:
    terms = np.zeros((LENGTH, len(REWARD_TERMS)), np.float32)
    terms[20, REWARD_TERMS.index("action_rate")] = -0.1
    terms[40, REWARD_TERMS.index("hit")] = -1.0
    terms[60, REWARD_TERMS.index("block")] = 1.0
    costs = replace(make_episode(0), reward=terms.sum(axis=1), reward_terms=terms)
    (rows,) = read_rows(write_episodes(tmp_path / "terms", [costs]), RETURNS)
    success, failure = events_ahead(rows, RETURNS.steps)
    assert np.flatnonzero(success).tolist() == [*range(51, 61)]
    assert np.flatnonzero(failure).tolist() == [*range(31, 41)]


def test_events_are_counted_per_tick_and_per_episode(found: DatasetStatistics) -> None:
    ball = found.tasks[0]
    steps = 2 * LENGTH + 41
    block, hands = ball.term_rates["block"], ball.term_rates["touch.hands"]
    assert (block.ticks, block.episodes) == (1, 1)
    assert block.per_1000_ticks == pytest.approx(1000 / steps)
    assert block.episode_share == pytest.approx(1 / 3)
    assert (hands.ticks, hands.episodes) == (3, 1)
    episodes = (ball.event_episodes, ball.success_event_episodes, ball.failure_event_episodes)
    assert episodes == (2, 1, 1)


def test_event_episodes_are_counted_by_column_not_by_the_name_of_the_term(tmp_path: Path) -> None:
    terms = np.zeros((2, LENGTH, len(REWARD_TERMS)), np.float32)
    terms[0, 20, REWARD_TERMS.index("block")] = 1.0
    terms[:, 40, REWARD_TERMS.index("pose")] = -0.01
    metadata = {"seed": 5, "episode": 0, "reward_terms": {"stop": {"sum": 1.0, "ticks": 1}}}
    episodes = [
        replace(
            make_episode(i), reward=t.sum(axis=1), reward_terms=t, task="bag", metadata=metadata
        )
        for i, t in enumerate(terms)
    ]
    (bag,) = compute_statistics(write_episodes(tmp_path / "bag", episodes), RETURNS).tasks
    assert (bag.event_episodes, bag.success_event_episodes, bag.failure_event_episodes) == (1, 1, 0)
    assert bag.has_success_events
    assert _event_colour("stop", bag.term_rates["stop"]) == _SUCCESS


def test_events_of_an_episode_without_terms_are_changes_of_the_reward(tmp_path: Path) -> None:
    terms = np.zeros((2, LENGTH, len(REWARD_TERMS)), np.float32)
    terms[0, 20, REWARD_TERMS.index("block")] = 1.0
    terms[1, 30, REWARD_TERMS.index("hit")] = -1.0
    recorded, older = (replace(make_episode(i), reward=t.sum(axis=1)) for i, t in enumerate(terms))
    episodes = [replace(recorded, reward_terms=terms[0]), older]
    found = compute_statistics(write_episodes(tmp_path / "mixed", episodes), RETURNS)
    (task,), (rows,) = found.tasks, found.rows
    assert (task.success_event_episodes, task.failure_event_episodes) == (1, 1)
    success, failure = (np.flatnonzero(event) for event in events_ahead(rows, 1))
    assert (success.tolist(), failure.tolist()) == ([20], [LENGTH + 30])


@pytest.mark.parametrize(("task", "expected"), [("wall", False), ("ball", True)])
def test_tasks_whose_reward_has_costs_only_have_no_success_events(
    task: str, expected: bool, tmp_path: Path
) -> None:
    reader = write_episodes(
        tmp_path / task, [make_episode(0, {40: -1.0}, task=task, terms=("hit",))]
    )
    assert compute_statistics(reader, RETURNS).tasks[0].has_success_events == expected


def test_outcomes_are_those_of_the_last_row(found: DatasetStatistics) -> None:
    ball, arch = found.tasks
    assert ball.success_share == pytest.approx(1 / 3)
    assert ball.fall_share == pytest.approx(1 / 3)
    assert arch.fall_share == 0.0


def test_drawn_parameters_have_their_range(found: DatasetStatistics) -> None:
    ball = found.tasks[0]
    radius = ball.scene["scene.radius"]
    assert (radius.low, radius.median, radius.high) == (0.1, 0.11, 0.12)
    assert set(ball.scene) == {"event_tick", "scene.radius"}


def test_the_source_of_a_merged_episode_is_not_drawn() -> None:
    assert [*drawn_parameters([{"source": 0, "event_tick": 5}])] == ["event_tick"]


def test_a_missing_parameter_is_skipped() -> None:
    assert drawn_parameters([{"event_tick": None}, {"event_tick": 7}])["event_tick"].low == 7


def test_depth_shares_count_pixels(found: DatasetStatistics) -> None:
    depth = found.tasks[0].depth
    assert depth.valid_share == pytest.approx(0.5)
    assert depth.empty_share == 0.0
    assert 0.0 < depth.near_share < depth.valid_share


def test_empty_frames_are_counted(tmp_path: Path) -> None:
    episode = make_episode(0, length=4, time_limit=4)
    episode.depth[1:] = 0
    found = compute_statistics(write_episodes(tmp_path / "blind", [episode]), RETURNS)
    assert found.tasks[0].depth.empty_share == pytest.approx(3 / 4)


def test_a_sample_has_twelve_episodes_and_shows_frames_from_the_event_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = [make_episode(i, length=30, time_limit=30) for i in range(20)]
    reader = write_episodes(tmp_path / "many", episodes)
    (rows,) = read_rows(reader, RETURNS)
    read: list[int] = []
    original = DatasetReader.read
    monkeypatch.setattr(DatasetReader, "read", lambda r, i: read.append(i) or original(r, i))
    sample = sample_episodes(reader, rows)
    assert len(read) == len(set(read)) == 12
    assert (min(read), max(read)) == (0, 19)
    for frames in sample.shown:
        assert frames.tick[0] == 20
        np.testing.assert_array_equal(frames.depth, episodes[frames.episode].depth[frames.tick])


def test_episodes_without_metadata_and_returns_have_empty_statistics(sound: Path) -> None:
    found = compute_statistics(DatasetReader.open(DatasetConfig(root=str(sound))), ReturnConfig())
    for task in found.tasks:
        assert task.returns.distribution is None
        assert task.returns.valid_share == 0.0
        assert task.term_rates == {}


def actions(n: int = 100_000) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (n, 7)).astype(np.float32)


def test_uniform_actions_fill_the_box_evenly() -> None:
    found = ActionStatistics.of(actions())
    assert min(found.uniformity.values()) > 0.98
    assert set(found.occupied.values()) == {1.0}


def test_a_single_action_is_one_bin_and_one_cell() -> None:
    found = ActionStatistics.of(np.zeros((50, 7), np.float32))
    assert [*found.uniformity.values()] == pytest.approx([1 / HISTOGRAM_BINS] * 7)
    assert set(found.occupied.values()) == {1 / GRID_CELLS**3}


def test_actions_on_the_faces_of_the_box_are_counted() -> None:
    edge = np.array([[-1.0] * 7, [1.0] * 7, [0.0] * 7], np.float32)
    found = ActionStatistics.of(edge)
    for counts in found.histogram.values():
        assert len(counts) == HISTOGRAM_BINS
        assert sum(counts) == 3
    for i, name in enumerate(ACTION_NAMES):
        assert found.workspace_m[name] == pytest.approx((ACTION_BOX.low[i], ACTION_BOX.high[i]))


def test_a_clipped_walk_is_less_even_than_a_reflected_one() -> None:
    steps = np.random.default_rng(1).uniform(-0.32, 0.32, (40_000, 7))
    clipped, reflected = np.zeros((2, len(steps), 7))
    for t in range(1, len(steps)):
        clipped[t] = np.clip(clipped[t - 1] + steps[t], -1, 1)
        reflected[t] = reflect(reflected[t - 1] + steps[t])
    least = {
        name: min(ActionStatistics.of(walk).uniformity.values())
        for name, walk in (("clipped", clipped), ("reflected", reflected))
    }
    assert least["clipped"] + 0.05 < least["reflected"]
    assert least["reflected"] > 0.95


def test_hands_are_counted_separately() -> None:
    moved = np.zeros((10_000, 7))
    moved[:, :3] = actions(10_000)[:, :3]
    found = ActionStatistics.of(moved)
    assert found.occupied["left"] > 0.9
    assert found.occupied["right"] == 1 / GRID_CELLS**3
