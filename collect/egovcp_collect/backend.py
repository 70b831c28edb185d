"""What a collection asks of those who simulate for it, wherever they run."""

from __future__ import annotations

import pickle
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from egovcp.data import Episode
from egovcp.data.staging import EncodedEpisode, StagedEpisode, encode
from egovcp.errors import DataError
from egovcp.sim.scenario import Scenario


@dataclass(frozen=True)
class Brief:
    """What the progress display needs to know of an episode."""

    number: int
    """Its number in the run."""
    steps: int
    """Planner ticks."""
    success: bool
    terms: dict[str, int]
    """Reward term -> ticks in which it was not zero."""
    hand_contacts: int
    """Ticks in which a hand touched the task's object."""

    @classmethod
    def of(cls, number: int, encoded: EncodedEpisode) -> Brief:
        """Summarise an episode."""
        metadata = encoded.record["metadata"]
        return cls(
            number,
            len(encoded),
            bool(encoded.table["next.success"][-1].as_py()),
            {name: term["ticks"] for name, term in metadata["reward_terms"].items()},
            metadata["contact_ticks"]["hands"],
        )


@dataclass(frozen=True)
class Report:
    """A sign of life of a worker."""

    steps: int
    """Planner ticks since its last report."""
    done: tuple[Brief, ...] = ()
    """Episodes that it has finished since."""
    sealed: tuple[StagedEpisode, ...] = ()
    """Those of them that it could not put into the spool itself."""
    failure: Exception | None = None
    """Why it has ended; nothing follows."""


class Worker(Protocol):
    """One process that simulates."""

    def give(self, scenarios: Sequence[Scenario]) -> None:
        """More episodes to play, after those it has."""
        ...

    def reports(self) -> list[Report]:
        """What has come in since the last call; does not wait."""
        ...

    @property
    def alive(self) -> bool:
        """Whether more reports can come."""
        ...

    def kill(self) -> None:
        """End it now, whatever it does; returns when it is gone."""
        ...


class Backend(Protocol):
    """Starts workers."""

    def start(self) -> Worker:
        """A new worker, which may still be getting ready."""
        ...

    @property
    def cores(self) -> int:
        """Processor cores that workers can have."""
        ...

    def wait(self, seconds: float) -> None:
        """Return when a worker has reported or died, or the time is over."""
        ...

    def close(self) -> None:
        """Free what the backend itself holds."""
        ...


def encode_numbered(number: int, episode: Episode) -> EncodedEpisode:
    """Validate and encode an episode of the run.

    Raises:
        DataError: it is not valid; the error's ``episode`` is ``number``.
    """
    try:
        return encode(episode, f"episode {number}")
    except DataError as error:
        error.episode = number
        raise


def portable(error: Exception) -> Exception:
    """The error, or what it says if it cannot travel between processes."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes, made one call before
    except Exception:  # noqa: BLE001 - an exception class may fail in any way here
        return RuntimeError("".join(traceback.format_exception_only(error)).strip())
    return error
