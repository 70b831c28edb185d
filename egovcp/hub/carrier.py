"""Files of the Hub, brought by a process beside this one.

HTTP in Python takes as much of a processor as decoding what has come, and within one process the
two take turns. The process is started by the first file that could come this way, serves all
shelves, and ends with this one. It is a convenience and no more: what it does not bring, for
whatever reason, this process fetches itself, as patiently as ever, and says what is wrong.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from typing import IO, Final

from egovcp.hub.patience import Line, Patience

_LOG = logging.getLogger(__name__)
_WORKERS: Final = 4
_FAREWELL_S: Final = 5.0


@dataclass(frozen=True)
class Errand:
    """A file of a dataset to bring into the library's cache."""

    repo_id: str
    commit: str
    name: str
    cache_dir: str
    endpoint: str
    token: str | None
    timeout_s: float
    """Longest silence within a request, s."""


class Carrier:
    """The process. It is ready a second after it was started, and not started again if it dies."""

    def __init__(self) -> None:
        """Start it."""
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self._waiting: dict[int, Future[bool]] = {}
        self._ready = False
        self._owner = os.getpid()
        self._process = _started()
        if self._process is not None:
            threading.Thread(target=self._listen, args=(self._process,), daemon=True).start()
            atexit.register(self.close)

    def carry(self, errand: Errand) -> bool:
        """Wait for a file; whether it is here. No, at once, as long as the process is not ready."""
        with self._lock:
            if not self._ready:
                return False
            number = next(self._numbers)
            answer = self._waiting[number] = Future[bool]()
            assert self._process is not None
            assert self._process.stdin is not None
            try:
                self._process.stdin.write(json.dumps([number, asdict(errand)]) + "\n")
                self._process.stdin.flush()
            except OSError:  # it is dead; `_listen` tells the others
                del self._waiting[number]
                return False
        return answer.result()

    def close(self) -> None:
        """End the process; nothing is carried any more."""
        process = self._process
        if process is None or os.getpid() != self._owner:  # a fork's is not its own
            return
        assert process.stdin is not None
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(_FAREWELL_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            answer = json.loads(line)
            with self._lock:
                if answer is None:
                    self._ready = True
                else:
                    number, brought = answer
                    self._waiting.pop(number).set_result(brought)
        with self._lock:
            self._ready = False
            for waiting in self._waiting.values():
                waiting.set_result(False)
            self._waiting.clear()
        _LOG.debug("the process that brings files has ended; this one brings them")


def carrier() -> Carrier:
    """The carrier of this process, started by the first call."""
    return _of(os.getpid())


@cache
def _of(process: int) -> Carrier:
    return Carrier()


def _started() -> subprocess.Popen[str] | None:
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # what goes wrong is told by who tries next
            text=True,
            start_new_session=True,  # Ctrl-C is answered by this process
        )
    except OSError as error:
        _LOG.debug("no process to bring files: %s", error)
        return None


class _Lines:
    """A line to the Hub for each limit of time; one try each, for others follow."""

    def __init__(self) -> None:
        self._lines: dict[float, Line] = {}
        self._lock = threading.Lock()

    def of(self, timeout_s: float) -> Line:
        with self._lock:
            patience = Patience(attempts=1, timeout_s=timeout_s)
            return self._lines.setdefault(timeout_s, Line(patience))


def _bring(errand: Errand, lines: _Lines) -> bool:
    from huggingface_hub import hf_hub_download

    try:
        with lines.of(errand.timeout_s).open():
            hf_hub_download(
                errand.repo_id,
                errand.name,
                repo_type="dataset",
                revision=errand.commit,
                cache_dir=errand.cache_dir,
                endpoint=errand.endpoint,
                token=errand.token or False,
            )
    except Exception:  # noqa: BLE001  whatever it is: who asked tries again, and explains
        return False
    return True


def serve(orders: IO[str], answers: IO[str]) -> None:
    """Do the errands of ``orders``, several at a time, until it ends: lines of JSON, [number,
    fields of `Errand`]. ``answers`` gets ``null`` first and then [number, whether it was brought]
    for each."""
    import huggingface_hub.file_download  # noqa: F401  takes a while, so before the first errand
    from huggingface_hub.utils.tqdm import disable_progress_bars

    lines, lock = _Lines(), threading.Lock()

    def say(what: object) -> None:
        with lock:
            print(json.dumps(what), file=answers, flush=True)

    def run(number: int, errand: Errand) -> None:
        say([number, _bring(errand, lines)])

    disable_progress_bars()
    pool = ThreadPoolExecutor(_WORKERS)
    say(None)
    for order in orders:
        number, fields = json.loads(order)
        pool.submit(run, number, Errand(**fields))
    pool.shutdown(wait=False, cancel_futures=True)


def main() -> None:
    """Entry point of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    serve(sys.stdin, sys.stdout)
    os._exit(
        0
    )  # whoever wanted the files has ended; what is half brought, the next one goes on with


if __name__ == "__main__":
    main()
