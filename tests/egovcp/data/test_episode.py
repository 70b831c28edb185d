from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from egovcp.data import Episode
from egovcp.data.episode import frame_layout
from egovcp.errors import DataError
from egovcp.robot_spec import G1


def _put(name: str, frame: int, value: object):  # type: ignore[no-untyped-def]
    def damage(episode: Episode) -> Episode:
        array = getattr(episode, name).copy()
        array[frame] = value
        return replace(episode, **{name: array})

    return damage


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_put("reward", 4, np.inf), "frame 4: reward is not finite"),
        (_put("action", 2, 1.5), "frame 2: action lies outside"),
        (_put("action", 2, np.nan), "frame 2: action is not finite"),
        (_put("reward_terms", 5, 3.0), "frame 5: reward differs from the sum of reward_terms"),
        (_put("object", 5, np.nan), "frame 5: object is not finite"),
        (_put("depth", 3, 60_000), "frame 3: depth exceeds"),
        (_put("done", 3, True), "frame 3: done must be set at the last frame"),
        (_put("done", -1, False), "frame 11: done must be set"),
        (_put("truncated", 0, True), "frame 0: truncated before the last frame"),
        (lambda e: replace(e, task=""), "no task, expected its name"),
        (lambda e: replace(e, time_limit=20), "time limit of 20"),
        (lambda e: replace(e, time_limit=5), "time limit of 5"),
        (lambda e: replace(e, state=e.state[:, :70]), r"state is float32 \(12, 70\), expected"),
        (lambda e: replace(e, reward=e.reward.astype(np.float64)), "expected float32"),
        (lambda e: replace(e, depth=e.depth[:5]), "depth is uint16"),
        (lambda e: replace(e, reward=e.reward[:0]), "no frames"),
    ],
)
def test_validate_names_the_violation(episodes: list[Episode], damage, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(DataError, match=message):
        damage(episodes[0]).validate()


def test_arrays_that_are_not_given_are_zeros_and_do_not_change_the_digest(
    episodes: list[Episode],
) -> None:
    given = vars(episodes[0])
    without = Episode(**{n: given[n] for n in given if n not in ("object", "reward_terms")})
    without.validate()
    assert without.object.shape == (12, 4)
    assert without.reward_terms.shape == (12, 6)
    assert not without.object.any()
    assert not without.reward_terms.any()
    one = replace(without, object=np.eye(12, 4, dtype=np.float32))
    assert len({without.digest(), one.digest(), episodes[0].digest()}) == 3
    assert replace(one, object=without.object).digest() == without.digest()


def test_valid_episodes_pass(episodes: list[Episode]) -> None:
    for episode in episodes:
        episode.validate()
    assert [e.terminated for e in episodes] == [False, True, False, True, False, False]


def test_an_episode_whose_depth_the_reader_would_refuse_is_refused() -> None:
    robot, length = replace(G1, depth=(144, 208)), 17_887
    arrays: dict[str, Any] = {
        name: np.broadcast_to(np.zeros((), dtype), (length, *shape))
        for name, (shape, dtype) in frame_layout(robot).items()
    }
    with pytest.raises(DataError, match="17887 frames, expected at most 17886 with depth images"):
        Episode(**arrays, task="ball", time_limit=length, robot=robot).validate()
