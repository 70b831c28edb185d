from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from egovcp.data import Episode
from egovcp.data.encoded import encode, from_buffer, to_bytes
from egovcp.data.episode import ARRAYS
from egovcp.errors import DataError


def test_bytes_hold_everything(episodes: list[Episode]) -> None:
    before = encode(episodes[1])
    after = from_buffer(to_bytes(before))
    assert after.table.equals(before.table)
    assert after.facts == before.facts
    np.testing.assert_array_equal(after.stats, before.stats)


def test_the_same_episode_gives_the_same_bytes(episodes: list[Episode]) -> None:
    assert to_bytes(encode(episodes[0])) == to_bytes(encode(episodes[0]))


@pytest.mark.parametrize("name", ARRAYS)
def test_the_digest_covers_every_array(episodes: list[Episode], name: str) -> None:
    array = getattr(episodes[0], name).copy()
    array.flat[-1] = not array.flat[-1] if array.dtype == np.bool_ else array.flat[-1] + 1
    assert replace(episodes[0], **{name: array}).digest() != episodes[0].digest()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["state", "action", "reward"])
def test_what_is_not_finite_is_never_encoded(
    episodes: list[Episode], name: str, bad: float
) -> None:
    rng = np.random.default_rng(hash(name) % 1000)
    array = getattr(episodes[0], name).copy()
    frame = int(rng.integers(len(array)))
    array.reshape(len(array), -1)[frame, -1] = bad
    with pytest.raises(DataError, match=rf"episode 7, frame {frame}: {name} is not finite"):
        encode(replace(episodes[0], **{name: array}), "episode 7")


@pytest.mark.parametrize("content", [b"", b"junk", b"ARROW1" * 20])
def test_other_content_is_refused(content: bytes) -> None:
    with pytest.raises(DataError, match="not a sealed episode"):
        from_buffer(pa.py_buffer(content))
