"""Options that name a dataset and select its episodes."""

from __future__ import annotations

from dataclasses import dataclass

from egovcp.bounds import bounded


@dataclass(frozen=True)
class DatasetConfig:
    """A LeRobot dataset on the Hub or on disk."""

    repo_id: str = ""
    """Dataset id, `user/name`; without root: LeRobot's local folder if it exists, else the Hub."""
    root: str = ""
    """Folder of the dataset on disk; empty: $HF_LEROBOT_HOME/REPO_ID, or a download."""
    revision: str = ""
    """Branch, tag or commit on the Hub; empty: the local copy, else main."""


@dataclass(frozen=True)
class SelectedDatasetConfig(DatasetConfig):
    """Dataset and selection of episodes."""

    episodes: str = ""
    """Only these episodes: numbers, `[0, 5, 7]`, half-open ranges, `0:1334`, or both,
    `[0:100, 250]`; empty: all."""


@dataclass(frozen=True)
class WeightedDatasetConfig(SelectedDatasetConfig):
    """One of several datasets to mix."""

    weight: float | None = bounded(None, least=0)
    """Share of the windows, relative to the other datasets; null (for all datasets or none):
    proportional to its frames."""
