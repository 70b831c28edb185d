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
from typing import IO, Any, Final

from tqdm import tqdm

from egovcp.hub.retry import RetryingClient, RetryPolicy

_LOG = logging.getLogger(__name__)
_WORKERS: Final = 16  # more than are asked for at a time: shelves limit themselves
_FAREWELL_S: Final = 5.0


class _NoBar(tqdm):  # type: ignore[misc]
    """A progress bar that does not appear in the middle of another one."""

    def __init__(self, *args: Any, **options: Any) -> None:
        options.pop("name", None)  # what Hugging Face's own bars take
        super().__init__(*args, **options | {"disable": True})


@dataclass(frozen=True)
class Errand:
    """A file of a dataset to bring into the library's cache."""

    repo_id: str
    commit: str
    name: str
    cache_dir: str
    endpoint: str
    token: str | None

    def run(self) -> None:
        """Bring it, or go on with what has come of it; raises what the library raises."""
        from huggingface_hub import hf_hub_download

        hf_hub_download(
            self.repo_id,
            self.name,
            repo_type="dataset",
            revision=self.commit,
            cache_dir=self.cache_dir,
            endpoint=self.endpoint,
            token=self.token or False,
            tqdm_class=_NoBar,
        )


class Carrier:
    """The process. It is ready a second after it was started, and not started again if it dies."""

    def __init__(self, timeout_s: float) -> None:
        """Start it; ``timeout_s`` is the longest silence within a request."""
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self._waiting: dict[int, Future[bool]] = {}
        self._ready = False
        self._owner = os.getpid()
        self._process = _started(timeout_s)
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


_carriers: dict[tuple[int, float], Carrier] = {}  # a fork's are its own
_making = threading.Lock()


def carrier(timeout_s: float) -> Carrier:
    """The one of this process with that limit of time, started by the first call."""
    with _making:
        key = (os.getpid(), timeout_s)
        if key not in _carriers:
            _carriers[key] = Carrier(timeout_s)
        return _carriers[key]


def _started(timeout_s: float) -> subprocess.Popen[str] | None:
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(timeout_s)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # what goes wrong is told by who tries next
            text=True,
            start_new_session=True,  # Ctrl-C is answered by this process
        )
    except OSError as error:
        _LOG.debug("no process to bring files: %s", error)
        return None


def serve(orders: IO[str], answers: IO[str], timeout_s: float) -> None:
    """Do the errands of ``orders``, several at a time, until it ends.

    Args:
        orders: lines of JSON, [number, fields of `Errand`].
        answers: gets ``null`` first and then, for each, [number, whether it was brought].
        timeout_s: longest silence within a request, s.
    """
    import huggingface_hub.file_download  # noqa: F401  takes a while, so before the first errand

    client = RetryingClient(RetryPolicy(attempts=1, timeout_s=timeout_s))
    lock = threading.Lock()

    def say(what: object) -> None:
        with lock:
            print(json.dumps(what), file=answers, flush=True)

    def run(number: int, errand: Errand) -> None:
        try:
            with client.open():
                errand.run()
        except Exception:  # noqa: BLE001  whatever it is: who asked tries again, and explains
            say([number, False])
        else:
            say([number, True])

    pool = ThreadPoolExecutor(_WORKERS)
    say(None)
    for order in orders:
        number, fields = json.loads(order)
        pool.submit(run, number, Errand(**fields))
    pool.shutdown(wait=False, cancel_futures=True)


def main() -> None:
    """Entry point of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    serve(sys.stdin, sys.stdout, float(sys.argv[1]))
    os._exit(
        0
    )  # whoever wanted the files has ended; what is half brought, the next one goes on with


if __name__ == "__main__":
    main()
