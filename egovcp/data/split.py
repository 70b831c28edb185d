"""Held-out episodes, chosen by a hash of what an episode *is*.

The choice depends on neither order nor number of episodes, so a dataset that is
extended, merged or read in part keeps the same episodes out of training.
"""

from __future__ import annotations

import hashlib
from typing import Final, Literal

from egovcp.errors import UsageError, suggest

type Split = Literal["train", "heldout", "all"]
SPLITS: Final = ("train", "heldout", "all")
HELDOUT_FRACTION: Final = 0.05


def is_heldout(identity: str, fraction: float = HELDOUT_FRACTION) -> bool:
    """Whether the episode of this identity is kept out of training."""
    digest = hashlib.sha256(identity.encode()).digest()
    return int.from_bytes(digest[:8], "big") < fraction * 2**64


def in_split(identity: str, split: str, fraction: float = HELDOUT_FRACTION) -> bool:
    """Whether the episode of this identity belongs to ``split``.

    Raises:
        UsageError: no such split.
    """
    if split not in SPLITS:
        raise UsageError(f"unknown split {split!r}{suggest(split, SPLITS)}")
    return split == "all" or is_heldout(identity, fraction) == (split == "heldout")
