"""Encoded episodes, and the folder in which they wait for the commit."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from egovcp.data import Episode
from egovcp.data.episode import FRAME_LAYOUT
from egovcp.data.staging import EncodedEpisode, StagingDir, encode, from_buffer, to_bytes
from egovcp.errors import DataError


def test_to_bytes_keeps_table_record_and_stats(episodes: list[Episode]) -> None:
    before = encode(episodes[1])
    after = from_buffer(to_bytes(before))
    assert after.table.equals(before.table)
    assert after.record == before.record
    np.testing.assert_array_equal(after.stats, before.stats)


def test_the_same_episode_gives_the_same_bytes(episodes: list[Episode]) -> None:
    assert to_bytes(encode(episodes[0])) == to_bytes(encode(episodes[0]))


@pytest.mark.parametrize("name", FRAME_LAYOUT)
def test_the_digest_covers_every_array(episodes: list[Episode], name: str) -> None:
    array = getattr(episodes[0], name).copy()
    array.flat[-1] = not array.flat[-1] if array.dtype == np.bool_ else array.flat[-1] + 1
    assert replace(episodes[0], **{name: array}).digest() != episodes[0].digest()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["state", "action", "reward"])
def test_encode_refuses_values_that_are_not_finite(
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
    with pytest.raises(DataError, match="not a staged episode"):
        from_buffer(pa.py_buffer(content))


@pytest.fixture
def staging(tmp_path: Path) -> StagingDir:
    folder = tmp_path / "sealed"
    folder.mkdir()
    return StagingDir(folder)


@pytest.fixture
def encoded(episodes: list[Episode]) -> EncodedEpisode:
    return encode(episodes[0])


def test_get_returns_what_was_put(
    staging: StagingDir, encoded: EncodedEpisode, episodes: list[Episode]
) -> None:
    staging.put(41, encoded)
    assert staging.numbers() == {41}
    found = staging.get(41)
    assert found is not None
    assert found.record["sha256"] == episodes[0].digest()
    assert staging.get(40) is None
    staging.drop_before(42)
    assert staging.numbers() == set()


@pytest.mark.parametrize("place", [0, 0.5, -1])
def test_a_flipped_bit_makes_an_episode_missing(
    staging: StagingDir, encoded: EncodedEpisode, place: float
) -> None:
    staging.put(41, encoded)
    (path,) = staging.folder.iterdir()
    content = bytearray(path.read_bytes())
    content[int(place * len(content)) if place >= 0 else -1] ^= 1
    path.write_bytes(content)
    assert staging.get(41) is None
    assert not path.exists()


def test_put_is_atomic_under_disk_failures(
    staging: StagingDir, encoded: EncodedEpisode, monkeypatch: pytest.MonkeyPatch, make_disk: Any
) -> None:
    failures = 0
    for n in range(1, 100):
        with monkeypatch.context() as patch:
            disk = make_disk(fail_at=n).install(patch)
            try:
                staging.put(41, encoded)
            except OSError:
                failures += 1
        staging.remove_invalid()
        assert staging.numbers() <= {41}
        assert staging.get(41) is not None or not staging.numbers()
        staging.drop_before(42)
        if disk.operations < n:
            break
    assert failures >= 4  # open, write, flush, rename at least


def test_remove_invalid_removes_partial_and_damaged_files(
    staging: StagingDir, encoded: EncodedEpisode
) -> None:
    staging.put(41, encoded)
    (whole,) = staging.folder.iterdir()
    (staging.folder / f".{whole.name}.123").write_bytes(b"half")
    (staging.folder / f"000000042-{'0' * 64}.arrow").write_bytes(b"torn by a power cut")
    (staging.folder / f"000000043-{hashlib.sha256(b'junk').hexdigest()}.arrow").write_bytes(b"junk")
    assert staging.get(43) is None
    (staging.folder / f"000000044-{hashlib.sha256(b'junk').hexdigest()}.arrow").write_bytes(b"junk")
    staging.remove_invalid()
    assert staging.numbers() == {41}
    assert list(staging.folder.iterdir()) == [whole]
