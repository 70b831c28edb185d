from pathlib import Path
from typing import Any

import pytest

from egovcp.data import Episode
from egovcp.data.encoded import encode
from egovcp.data.spool import SealedEpisode, Spool
from egovcp.errors import EnvironmentFailure


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    folder = tmp_path / "sealed"
    folder.mkdir()
    return Spool(folder)


@pytest.fixture
def sealed(episodes: list[Episode]) -> SealedEpisode:
    return SealedEpisode.of(41, encode(episodes[0]))


def test_what_was_put_can_be_got(
    spool: Spool, sealed: SealedEpisode, episodes: list[Episode]
) -> None:
    spool.put(sealed)
    assert spool.numbers() == {41}
    found = spool.get(41)
    assert found is not None
    assert found.facts["sha256"] == episodes[0].digest()
    assert spool.get(40) is None
    spool.drop_before(42)
    assert spool.numbers() == set()


@pytest.mark.parametrize("place", [0, 0.5, -1])
def test_a_flipped_bit_makes_an_episode_missing(
    spool: Spool, sealed: SealedEpisode, place: float
) -> None:
    spool.put(sealed)
    (path,) = spool.folder.iterdir()
    content = bytearray(path.read_bytes())
    content[int(place * len(content)) if place >= 0 else -1] ^= 1
    path.write_bytes(content)
    assert spool.get(41) is None
    assert not path.exists()


def test_bytes_that_changed_on_their_way_are_refused(sealed: SealedEpisode) -> None:
    torn = SealedEpisode(41, sealed.sha256, sealed.payload[:-1])
    with pytest.raises(EnvironmentFailure, match="episode 41 arrived damaged"):
        torn.require_whole()
    sealed.require_whole()


def test_whatever_fails_there_is_a_whole_episode_or_none(
    spool: Spool, sealed: SealedEpisode, monkeypatch: pytest.MonkeyPatch, make_disk: Any
) -> None:
    failures = 0
    for n in range(1, 100):
        with monkeypatch.context() as patch:
            disk = make_disk(fail_at=n).install(patch)
            try:
                spool.put(sealed)
            except OSError:
                failures += 1
        spool.sweep()
        assert spool.numbers() <= {41}
        assert spool.get(41) is not None or not spool.numbers()
        spool.drop_before(42)
        if disk.operations < n:
            break
    assert failures >= 4  # open, write, flush, rename at least


def test_leftovers_are_swept(spool: Spool, sealed: SealedEpisode) -> None:
    spool.put(sealed)
    (whole,) = spool.folder.iterdir()
    (spool.folder / f".{whole.name}.123").write_bytes(b"half")
    (spool.folder / f"000000042-{'0' * 64}.arrow").write_bytes(b"torn by a power cut")
    spool.sweep()
    assert spool.numbers() == {41}
    assert list(spool.folder.iterdir()) == [whole]
