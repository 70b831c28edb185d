"""Files of a commit that are downloaded when they are needed."""

import threading
from pathlib import Path

import pytest

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.hub import Content, HubFileCache, Publication, RetryPolicy, publish
from tests.support.hub import FakeHub

DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture
def cache(
    hub: FakeHub, publication: Publication, quick: RetryPolicy, tmp_path: Path
) -> HubFileCache:
    commit = publish(publication, quick).commit
    found = HubFileCache("me/small", "", quick, tmp_path / "cache", ["meta/*"])
    assert found.commit == commit
    return found


def _wait(cache: HubFileCache) -> None:
    """Wait until nothing is being prefetched."""
    for thread in list(cache._prefetching.values()):
        thread.join(20)
        assert not thread.is_alive()


def test_get_downloads_a_file_once(
    cache: HubFileCache, hub: FakeHub, publication: Publication
) -> None:
    assert cache.has("meta/info.json")
    assert not cache.has(DATA)
    assert cache.get(DATA).read_bytes() == publication.contents[DATA].source
    hub.reset()
    cache.get(DATA)
    assert not hub.requests


def test_prefetch_downloads_a_file(cache: HubFileCache, hub: FakeHub) -> None:
    cache.prefetch(["meta/info.json", DATA])
    _wait(cache)
    assert cache.has(DATA)


def test_a_file_that_is_being_prefetched_is_requested_once(
    cache: HubFileCache, hub: FakeHub, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = threading.Event(), threading.Event()
    download = HubFileCache._download

    def slow(self: HubFileCache, name: str) -> None:
        begun.set()
        go_on.wait(20)
        download(self, name)

    monkeypatch.setattr(HubFileCache, "_download", slow)
    hub.reset()
    cache.prefetch([DATA])
    assert begun.wait(20)
    cache.prefetch([DATA])
    threading.Timer(0.1, go_on.set).start()
    assert cache.get(DATA).exists()
    assert hub.requests["resolve"] == 1


def test_get_retries_a_failed_prefetch(cache: HubFileCache, hub: FakeHub) -> None:
    hub.fail("*", 503)
    cache.prefetch([DATA])
    _wait(cache)
    assert not cache.has(DATA)
    with pytest.raises(EnvironmentFailure, match="503"):
        cache.get(DATA)
    hub.reset()
    assert cache.get(DATA).exists()


def test_a_commit_that_lacks_a_file_is_a_data_error(cache: HubFileCache) -> None:
    with pytest.raises(DataError, match=r"has no data/other\.parquet; .* incomplete"):
        cache.get("data/other.parquet")


def test_files_are_those_of_the_opened_commit(
    cache: HubFileCache, quick: RetryPolicy, publication: Publication
) -> None:
    other = dict(publication.contents) | {DATA: Content(b"other")}
    publish(Publication("me/small", other, "another version"), quick)
    assert cache.get(DATA).read_bytes() == publication.contents[DATA].source
