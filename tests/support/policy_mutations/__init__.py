"""Seeded mutations of a policy folder, for tests of what a loader must refuse.

Most mutations renew the digests afterwards, so that the content itself must be found invalid.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tests.support.policy_mutations.editing import ANY_FILE, MARKER, Mutate
from tests.support.policy_mutations.folders import FOLDER_MUTATIONS
from tests.support.policy_mutations.texts import TEXT_MUTATIONS
from tests.support.policy_mutations.weights import WEIGHT_MUTATIONS

__all__ = ["ANY_FILE", "MARKER", "Mutation", "mutate_policy"]

_MUTATIONS: Final[tuple[Mutate, ...]] = (*WEIGHT_MUTATIONS, *TEXT_MUTATIONS, *FOLDER_MUTATIONS)


@dataclass(frozen=True)
class Mutation:
    """What was done to a policy folder."""

    name: str
    culprit: str | None
    """Files, separated by ``|``, one of which the refusal must name; None: the policy loads;
    `ANY_FILE`: either."""


def mutate_policy(folder: Path, seed: int) -> Mutation:
    """Damage the policy in ``folder``; equal seeds give equal damage, and seeds that follow each
    other different kinds of it."""
    mutate = _MUTATIONS[seed % len(_MUTATIONS)]
    culprit = mutate(folder, np.random.default_rng(seed))
    return Mutation(mutate.__name__.strip("_"), culprit)
