"""stable-worldmodel's Lance reader in a process of its own, under an interpreter that has it."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from egovcp.data import EpisodeIndex
from egovcp.data.parquet import EPISODE_FEATURES

CASES = ("lance", "lance_jpeg")


class LanceReader:
    """Measures on demand; see `lance_windows`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._answer()  # it has written its tables

    def measure(self, case: str, seconds: float) -> tuple[float, float]:
        """Windows per second of processor time and of wall clock."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{case} {seconds}\n")
        self._process.stdin.flush()
        by_processor, by_clock = self._answer().split()
        return float(by_processor), float(by_clock)

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("the Lance reader ended; its own words are above")
        return line


@contextlib.contextmanager
def lance_reader(
    python: Path, index: EpisodeIndex, folder: Path, length: int, batch: int
) -> Iterator[LanceReader]:
    """The reader over the same episodes, which are handed to it as arrays."""
    folder.mkdir()
    np.save(folder / "length.npy", index.length)
    for name, key in EPISODE_FEATURES.items():
        columns = (
            index.readers[d].read_episode_columns(int(i), [key])[key] for d, i in index_at(index)
        )
        np.save(folder / f"{name}.npy", np.concatenate(list(columns)))
    script = Path(__file__).with_name("lance_windows.py")
    command = [python, "-P", script, folder, str(length), str(batch)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield LanceReader(process)
        finally:
            process.stdin.close()  # type: ignore[union-attr]
            process.wait(30)


def index_at(index: EpisodeIndex) -> Iterator[tuple[int, int]]:
    """Dataset and number of each episode."""
    return zip(index.dataset.tolist(), index.number.tolist(), strict=True)
