"""Live progress of a collection: episodes, steps per second, how often things happen, disk use."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

from tqdm import tqdm

from egovcp_collect.backend import Report

_RARE: Final = 0.2  # a reward term that acts in fewer ticks than this counts as an event
_LOOK: Final = 5.0  # s between looks at the disk


class Progress:
    """Progress bar over episodes, those of earlier runs included; rates are of this run."""

    def __init__(self, episodes: int, already: int, disk_bytes: Callable[[], int]) -> None:
        self._bar = tqdm(
            total=episodes,
            initial=already,
            unit="ep",
            smoothing=0.1,
            mininterval=0.5 if sys.stderr.isatty() else 10,
        )
        self._disk_bytes = disk_bytes
        self._disk, self._looked = 0, -_LOOK
        self._began = time.monotonic()
        self._simulated = 0
        self._steps = 0
        self._episodes = 0
        self._successes = 0
        self._ticks: Counter[str] = Counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.close()

    @property
    def rate(self) -> float:
        """Planner ticks per second since the start, unfinished episodes included."""
        return self._simulated / max(1e-9, time.monotonic() - self._began)

    def add(self, report: Report) -> None:
        """Count what a worker reports."""
        self._simulated += report.steps
        for brief in report.done:
            self._steps += brief.steps
            self._episodes += 1
            self._successes += brief.success
            self._ticks["hand contact"] += brief.hand_contacts
            self._ticks.update(brief.terms)
        self._bar.update(len(report.done))

    def show(self) -> None:
        """Refresh the figures."""
        if time.monotonic() - self._looked > _LOOK:
            self._disk, self._looked = self._disk_bytes(), time.monotonic()
        text = f"{self.rate:.0f} steps/s, {self._disk / 1e9:.2f} GB{self._events()}"
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(0)

    def _events(self) -> str:
        """Successes per episode, and what is rare per 1000 steps."""
        if not self._episodes:
            return ""
        rates = "".join(
            f", {name} {1000 * ticks / self._steps:.1f}"
            for name, ticks in self._ticks.items()
            if ticks < _RARE * self._steps
        )
        return f", success {self._successes / self._episodes:.0%}; per 1000 steps{rates[1:]}"
