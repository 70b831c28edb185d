"""The survey counts what is in the episodes."""

from pathlib import Path

import numpy as np
import pytest

from egovcp.data import DatasetReader, EpisodeStore, ReturnConfig
from egovcp_collect.dataset.rows import read_rows
from egovcp_collect.dataset.sample import take_sample
from egovcp_collect.dataset.survey import Survey, drawn, events_ahead, survey

from .scenes import LENGTH, scene, three_balls, write_scenes

RETURNS = ReturnConfig(steps=10)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> DatasetReader:
    """Three balls and, between them, an arch."""
    first, *others = three_balls()
    arch = scene(3, {5: -0.1}, task="arch", terms=("head",), length=30, time_limit=30)
    return write_scenes(tmp_path_factory.mktemp("data") / "mixed", [first, arch, *others])


@pytest.fixture(scope="module")
def found(reader: DatasetReader) -> Survey:
    return survey(reader, RETURNS)


def test_tasks_share_the_steps(found: Survey, reader: DatasetReader) -> None:
    assert [task.task for task in found.tasks] == ["ball", "arch"]
    assert sum(task.steps for task in found.tasks) == reader.num_frames
    assert sum(task.step_share for task in found.tasks) == pytest.approx(1.0)


def test_returns_are_those_that_training_sees(reader: DatasetReader) -> None:
    store = EpisodeStore.load([reader], returns=RETURNS)
    for rows in read_rows(reader, RETURNS):
        mine = np.repeat([task == rows.task for task in store.tasks], store.length)
        np.testing.assert_array_equal(rows.mc_return, store.mc_return[mine])
        np.testing.assert_array_equal(rows.mc_valid, store.mc_valid[mine])
        np.testing.assert_array_equal(rows.action, store.action[mine])


def test_rewards_ahead_are_found_by_looking(reader: DatasetReader) -> None:
    for rows in read_rows(reader, RETURNS):
        good, bad = events_ahead(rows, RETURNS.steps)
        for span in rows.spans():
            reward = rows.reward[span]
            windows = [reward[t : t + RETURNS.steps] for t in range(len(reward))]
            assert good[span].tolist() == [bool((w > 0).any()) for w in windows]
            assert bad[span].tolist() == [bool((w < 0).any()) for w in windows]


def test_events_are_counted_per_tick_and_per_episode(found: Survey) -> None:
    ball = found.tasks[0]
    steps = 2 * LENGTH + 41
    block, hands = ball.events["block"], ball.events["touch.hands"]
    assert (block.ticks, block.episodes) == (1, 1)
    assert block.per_1000_steps == pytest.approx(1000 / steps)
    assert block.episode_share == pytest.approx(1 / 3)
    assert (hands.ticks, hands.episodes) == (3, 1)
    assert (ball.moments, ball.good_moments, ball.bad_moments) == (2, 1, 1)


def test_outcomes_are_those_of_the_last_row(found: Survey) -> None:
    ball, arch = found.tasks
    assert ball.success_share == pytest.approx(1 / 3)
    assert ball.fall_share == pytest.approx(1 / 3)
    assert arch.fall_share == 0.0


def test_drawn_parameters_keep_their_range_and_nothing_else_counts(found: Survey) -> None:
    ball = found.tasks[0]
    radius = ball.scene["scene.radius"]
    assert (radius.low, radius.median, radius.high) == (0.1, 0.11, 0.12)
    assert set(ball.scene) == {"event_tick", "scene.radius"}


def test_a_parameter_that_was_not_drawn_is_no_number() -> None:
    assert drawn([{"event_tick": None}, {"event_tick": 7}])["event_tick"].low == 7


def test_depth_is_judged_from_pixels(found: Survey) -> None:
    depth = found.tasks[0].depth
    assert depth.valid_share == pytest.approx(0.5)
    assert depth.empty_share == 0.0
    assert 0.0 < depth.near_share < depth.valid_share


def test_a_blind_camera_shows(tmp_path: Path) -> None:
    episode = scene(0, length=4, time_limit=4)
    episode.depth[1:] = 0
    found = survey(write_scenes(tmp_path / "blind", [episode]), RETURNS)
    assert found.tasks[0].depth.empty_share == pytest.approx(3 / 4)


def test_a_sample_reads_few_episodes_and_its_strips_begin_with_the_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = [scene(i, length=30, time_limit=30) for i in range(20)]
    reader = write_scenes(tmp_path / "many", episodes)
    (rows,) = read_rows(reader, RETURNS)
    read: list[int] = []
    original = DatasetReader.read
    monkeypatch.setattr(DatasetReader, "read", lambda r, i: read.append(i) or original(r, i))
    sample = take_sample(reader, rows)
    assert len(read) == len(set(read)) == 12
    assert (min(read), max(read)) == (0, 19)
    for strip in sample.strips:
        assert strip.tick[0] == 20
        np.testing.assert_array_equal(strip.depth, episodes[strip.episode].depth[strip.tick])


def test_episodes_without_facts_and_without_returns_are_surveyed(sound: Path) -> None:
    from egovcp.data import DatasetConfig

    found = survey(DatasetReader.open(DatasetConfig(root=str(sound))), ReturnConfig())
    for task in found.tasks:
        assert task.returns.spread is None
        assert task.returns.valid_share == 0.0
        assert task.events == {}
        assert task.moments == 0
