"""Finds episodes that occur twice: with equal content, or of the same scenario."""

from __future__ import annotations

from dataclasses import dataclass

from egovcp.data.origin import ScenarioKey


@dataclass(frozen=True)
class Duplicate[P]:
    """The earlier episode that an episode repeats."""

    place: P
    """Where the earlier episode is."""
    equal: bool
    """Whether the content is equal. If not, seed, number and provenance are, so that one of the two
    was altered, or they were simulated on different machines."""

    def problem(self, scenario: ScenarioKey | None) -> str:
        """What is wrong with the later episode, which simulates ``scenario``."""
        if self.equal:
            return f"repeats episode {self.place}"
        return f"is {scenario}, and so is episode {self.place}, of other content"


class DuplicateFinder[P]:
    """Finds repeated episodes among those passed to `add`; ``P`` is the type of a place."""

    def __init__(self) -> None:
        self._by_digest: dict[str, P] = {}
        self._by_scenario: dict[ScenarioKey, P] = {}

    def add(self, place: P, digest: str, scenario: ScenarioKey | None) -> Duplicate[P] | None:
        """The earlier episode that this one repeats, if there is one.

        Args:
            place: where the episode is.
            digest: its `Episode.digest`.
            scenario: what it simulates; None: unknown.
        """
        if digest in self._by_digest:
            return Duplicate(self._by_digest[digest], equal=True)
        self._by_digest[digest] = place
        if scenario is None:
            return None
        if scenario in self._by_scenario:
            return Duplicate(self._by_scenario[scenario], equal=False)
        self._by_scenario[scenario] = place
        return None
