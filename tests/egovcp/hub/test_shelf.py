"""Files of a commit that come when they are needed."""

import threading
from pathlib import Path

import pytest

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.hub import Content, Publication, RetryPolicy, Shelf, publish
from tests.support.hub import FakeHub

DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture
def shelf(hub: FakeHub, publication: Publication, quick: RetryPolicy, tmp_path: Path) -> Shelf:
    commit = publish(publication, quick).commit
    found = Shelf.open("me/small", "", quick, tmp_path / "cache", ["meta/*"])
    assert found.commit == commit
    return found


def _wait(shelf: Shelf) -> None:
    """Until nothing is on its way."""
    for thread in list(shelf._coming.values()):
        thread.join(20)
        assert not thread.is_alive()


def test_a_file_comes_when_it_is_asked_for_and_stays(
    shelf: Shelf, hub: FakeHub, publication: Publication
) -> None:
    assert shelf.has("meta/info.json")
    assert not shelf.has(DATA)
    assert shelf.bring(DATA).read_bytes() == publication.contents[DATA].source
    hub.heal()
    shelf.bring(DATA)
    assert not hub.requests


def test_an_expected_file_comes_meanwhile(shelf: Shelf, hub: FakeHub) -> None:
    shelf.expect(["meta/info.json", DATA])
    _wait(shelf)
    assert shelf.has(DATA)


def test_a_file_that_is_on_its_way_is_not_asked_for_twice(
    shelf: Shelf, hub: FakeHub, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = threading.Event(), threading.Event()
    carried = Shelf._carried

    def slow(self: Shelf, name: str) -> bool:
        begun.set()
        go_on.wait(20)
        return carried(self, name)

    monkeypatch.setattr(Shelf, "_carried", slow)
    hub.heal()
    shelf.expect([DATA])
    assert begun.wait(20)
    shelf.expect([DATA])
    threading.Timer(0.1, go_on.set).start()
    assert shelf.bring(DATA).exists()
    assert hub.requests["resolve"] == 1


def test_a_file_that_could_not_come_ahead_is_asked_for_again(shelf: Shelf, hub: FakeHub) -> None:
    hub.fail("*", 503)
    shelf.expect([DATA])
    _wait(shelf)
    assert not shelf.has(DATA)
    with pytest.raises(EnvironmentFailure, match="503"):
        shelf.bring(DATA)
    hub.heal()
    assert shelf.bring(DATA).exists()


def test_a_commit_that_lacks_a_file_is_a_data_error(shelf: Shelf) -> None:
    with pytest.raises(DataError, match=r"has no data/other\.parquet; .* incomplete"):
        shelf.bring("data/other.parquet")


def test_a_commit_stays_the_same_whatever_is_published(
    shelf: Shelf, quick: RetryPolicy, publication: Publication
) -> None:
    other = dict(publication.contents) | {DATA: Content(b"other")}
    publish(Publication("me/small", other, "another version"), quick)
    assert shelf.bring(DATA).read_bytes() == publication.contents[DATA].source
