"""The terminal output of a run on the wall clock: log lines above a progress bar."""

from __future__ import annotations

import sys
import threading
from contextlib import suppress
from queue import Full, Queue
from typing import Any, Final

from tqdm import tqdm

from egovcp.log.tick import Tick
from egovcp.terminal import one_line

_WAITING: Final = 100  # ticks and warnings; more are dropped
_CLOSE_S: Final = 1.0


class _Bar(tqdm):  # type: ignore[misc]
    """A progress bar whose lock is not that of other bars: tqdm keeps it when a write fails."""

    monitor_interval = 0  # no thread that waits for the lock


class Display:
    """Prints from a thread: a stopped terminal or a full pipe blocks the writer, and the loop that
    passes on the emergency stop must not wait for it. What does not fit into the queue is dropped.
    """

    def __init__(self) -> None:
        self._queue = Queue[Tick | str | None](_WAITING)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def show(self, tick: Tick) -> None:
        """Print the events of ``tick``, its mode and its planning time."""
        self._put(tick)

    def warn(self, line: str) -> None:
        """Print ``line`` on stderr."""
        self._put(line)

    def close(self) -> None:
        """End the progress bar; waits at most `_CLOSE_S` for what is not printed yet."""
        self._put(None)
        self._thread.join(_CLOSE_S)

    def _put(self, item: Tick | str | None) -> None:
        with suppress(Full):
            self._queue.put_nowait(item)

    def _run(self) -> None:
        _Bar.set_lock(threading.RLock())
        # The errors are those of a closed terminal or pipe; the other stream may still be open.
        with suppress(OSError, ValueError), _Bar(unit="tick", desc="live") as bar:
            while (item := self._queue.get()) is not None:
                with suppress(OSError, ValueError):
                    _print(bar, item)


def _print(bar: Any, item: Tick | str) -> None:
    if isinstance(item, str):
        bar.write(one_line(item), file=sys.stderr)
        return
    for event in item.events:
        bar.write(one_line(f"{item.time_ns / 1e9:8.2f} s  {event}"))
    plan = f", plan {item.timing_ms['plan']:.0f} ms" if "plan" in item.timing_ms else ""
    bar.set_postfix_str(f"{item.mode}{plan}", refresh=False)
    bar.update(1)
