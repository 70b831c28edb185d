"""Damages a dataset in ways that a seed chooses, for the test of what `check` must find.

Whoever can write the files can also write their SHA-256: what is wrong must be found in the
content, so that the list of them is renewed or removed after most mutations.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from .mutation_editing import MARKER, Mutate
from .mutation_files import FILE_MUTATIONS
from .mutation_tables import TABLE_MUTATIONS
from .mutation_text import TEXT_MUTATIONS

__all__ = ["MARKER", "MUTATIONS", "DatasetMutation", "mutate"]

MUTATIONS: Final[tuple[Mutate, ...]] = (*FILE_MUTATIONS, *TEXT_MUTATIONS, *TABLE_MUTATIONS)


@dataclass(frozen=True)
class DatasetMutation:
    """What was done to a dataset."""

    name: str
    files: tuple[str, ...]
    """Those one of which the refusal must name."""


def mutate(root: Path, seed: int) -> DatasetMutation:
    """Damage a dataset; equal seeds give equal damage, and seeds that follow each other different
    kinds of it."""
    rng = np.random.default_rng(seed)
    function = MUTATIONS[seed % len(MUTATIONS)]
    files = function(root, rng)
    return DatasetMutation(function.__name__.strip("_"), tuple(files.split("|")))
