"""Live progress of a collection: episodes, steps per second, how often things happen."""

from __future__ import annotations

import sys
import time
from collections import Counter
from types import TracebackType
from typing import Self

from tqdm import tqdm

from egovcp.data import Episode

_RARE = 0.2  # a reward term that acts in fewer ticks than this counts as an event


class Progress:
    """Progress bar over episodes; events are given as the share of episodes that had them."""

    def __init__(self, episodes: int) -> None:
        self._bar = tqdm(
            total=episodes, unit="ep", smoothing=0.1, mininterval=0.5 if sys.stderr.isatty() else 10
        )
        self._began = time.monotonic()
        self._ticks: Counter[str] = Counter()
        self._episodes: Counter[str] = Counter()
        self.steps = 0

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
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._began

    def add(self, episode: Episode) -> None:
        """Count an episode that was written."""
        self.steps += len(episode)
        self._episodes["fall"] += episode.terminated
        self._episodes["success"] += bool(episode.success[-1])
        for name, term in episode.metadata["reward_terms"].items():
            self._ticks[name] += term["ticks"]
            if name != "fall":
                self._episodes[name] += term["ticks"] > 0
        self._bar.update(1)

    def show(self, simulated: int) -> None:
        """Refresh the figures; ``simulated`` counts the ticks of unfinished episodes too."""
        text = f"{simulated / self.elapsed:.0f} steps/s{self._events()}"
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(0)

    def summary(self) -> str:
        """The last line of the command."""
        rate = self.steps / self.elapsed
        return f"{self._bar.n} episodes, {self.steps} steps, {rate:.0f} steps/s"

    def _events(self) -> str:
        """Share of the episodes written so far in which each rare thing happened."""
        written = max(1, self._bar.n)
        return "".join(
            f", {name} {count / written:.0%}"
            for name, count in self._episodes.items()
            if self._ticks[name] < _RARE * max(1, self.steps)
        )
