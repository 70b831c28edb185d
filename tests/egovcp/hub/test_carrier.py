"""Files that a process beside this one brings."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.hub import Publication, RetryPolicy, Shelf, publish
from egovcp.hub import carrier as carriers
from egovcp.hub import shelf as shelves
from egovcp.hub.carrier import Carrier, Errand, serve
from egovcp.hub.retry import RetryingClient, http_library, uses_default_client
from tests.support.hub import FakeHub, client_factory

DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture
def carrier(monkeypatch: pytest.MonkeyPatch) -> Iterator[Carrier]:
    """One that is ready, in the place of the process's own."""
    found = Carrier(20.0)
    monkeypatch.setattr(shelves, "carrier", lambda _: found)
    _until(lambda: found._ready)
    yield found
    found.close()


@pytest.fixture
def shelf(hub: FakeHub, publication: Publication, quick: RetryPolicy, tmp_path: Path) -> Shelf:
    publish(publication, quick)
    return Shelf.open("me/small", "", quick, tmp_path / "cache", ["meta/*"])


def _until(true: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def _expect(shelf: Shelf) -> None:
    shelf.expect([DATA])
    _until(lambda: not shelf._coming)


def _errand(hub: FakeHub, shelf: Shelf) -> Errand:
    return Errand("me/small", shelf.commit, DATA, str(shelf._cache_dir), hub.endpoint, None)


def test_what_is_expected_comes_by_the_process(
    carrier: Carrier, shelf: Shelf, publication: Publication, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Shelf, "_fetch", lambda *_: pytest.fail("fetched by this process"))
    _expect(shelf)
    assert shelf.bring(DATA).read_bytes() == publication.contents[DATA].source


def test_what_the_process_fails_to_bring_is_fetched_as_ever(
    carrier: Carrier, shelf: Shelf, hub: FakeHub
) -> None:
    hub.fail("*", 503)
    assert not carrier.carry(_errand(hub, shelf))
    _expect(shelf)
    with pytest.raises(EnvironmentFailure, match="503"):
        shelf.bring(DATA)
    hub.heal()
    _expect(shelf)
    assert shelf.has(DATA)


def test_a_process_that_dies_leaves_nobody_waiting(
    carrier: Carrier, shelf: Shelf, hub: FakeHub
) -> None:
    assert carrier._process is not None
    os.kill(carrier._process.pid, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(carrier.carry, _errand(hub, shelf))
        _until(lambda: carrier._waiting)
        os.kill(carrier._process.pid, signal.SIGKILL)
        assert not answer.result(20)
    assert not carrier.carry(_errand(hub, shelf))
    _expect(shelf)
    assert shelf.has(DATA)


def test_the_process_ends_with_whoever_has_it(carrier: Carrier) -> None:
    assert carrier._process is not None
    carrier.close()
    assert carrier._process.returncode == 0


def test_the_process_ends_with_a_killed_one() -> None:
    script = (
        "import time; from egovcp.hub.carrier import Carrier; c = Carrier(5.0)\n"
        "while not c._ready: time.sleep(0.01)\n"
        "print(c._process.pid, flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", script]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        child = psutil.Process(int(owner.stdout.readline()))
        owner.kill()
    _until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


def test_threads_that_come_at_once_share_one(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[float] = []

    def slow(timeout_s: float) -> None:
        time.sleep(0.1)
        made.append(timeout_s)

    monkeypatch.setattr(carriers, "_carriers", {})
    monkeypatch.setattr(carriers, "Carrier", slow)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(carriers.carrier, [5.0] * 3))
    assert made == [5.0]


def test_it_starts_nothing_that_cannot_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    found = Carrier(1.0)
    assert not found.carry(Errand("me/small", "", DATA, "", "", None))
    found.close()


def test_errands_are_answered_by_their_numbers(hub: FakeHub, shelf: Shelf) -> None:
    good = _errand(hub, shelf)
    orders = [[7, vars(good)], [8, {**vars(good), "name": "data/other.parquet"}]]
    answers = io.StringIO()
    serve(io.StringIO("".join(json.dumps(order) + "\n" for order in orders)), answers, 5.0)
    _until(lambda: answers.getvalue().count("\n") == 3)
    said = [json.loads(line) for line in answers.getvalue().splitlines()]
    assert said[0] is None
    assert sorted(said[1:]) == [[7, True], [8, False]]


def test_a_client_of_ones_own_is_used(
    shelf: Shelf, quick: RetryPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shelves, "carrier", lambda _: pytest.fail("by a process without it"))
    assert uses_default_client()
    with client_factory(lambda: http_library().Client(follow_redirects=True)):
        assert not uses_default_client()
        with RetryingClient(quick).open():
            assert not uses_default_client()
        _expect(shelf)
        assert shelf.has(DATA)
    with RetryingClient(quick).open():
        assert uses_default_client()
