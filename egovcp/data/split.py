"""Held-out episodes, chosen by a hash of what an episode *is*.

The choice depends on neither order nor number of episodes, so a dataset that is
extended, merged or read in part keeps the same episodes out of training.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Final

from egovcp.errors import UsageError, suggest

SPLITS: Final = ("train", "heldout", "all")
HELDOUT_FRACTION: Final = 0.05


def in_split(
    identities: Sequence[str], split: str, fraction: float = HELDOUT_FRACTION
) -> list[bool]:
    """Which of the episodes with these identities belong to ``split``.

    An episode is held out if its hash, as a share of all hashes, is below ``fraction``. If
    that takes none of at least two episodes, the one with the lowest hash is held out, so
    that a small dataset can be trained on as well.

    Raises:
        UsageError: no such split.
    """
    if split not in SPLITS:
        raise UsageError(f"unknown split {split!r}{suggest(split, SPLITS)}")
    if split == "all":
        return [True] * len(identities)
    shares = [_share(identity) for identity in identities]
    bound = fraction
    if min(shares) >= fraction > 0:
        bound = min((share for share in shares if share > min(shares)), default=fraction)
    return [(share < bound) == (split == "heldout") for share in shares]


def _share(identity: str) -> float:
    """The identity's hash as a number in [0, 1)."""
    digest = hashlib.sha256(identity.encode()).digest()
    return int.from_bytes(digest[:8], "big") / 2**64
