"""Which episodes are held out, in a form that is short enough for the artifact they judge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from egovcp.data.index import EpisodeIndex
from egovcp.data.reader import DatasetReader
from egovcp.data.split import HELDOUT_FRACTION

#: At most so many numbers are listed; the fingerprint and the rule say the rest.
LISTED: Final = 5000
RULE: Final = (
    "the first 8 bytes of the SHA-256 of task/seed/episode, as a share of 2**64, are below the "
    "fraction; if none is, the episode with the lowest share"
)


def describe_heldout(
    readers: Sequence[DatasetReader], fraction: float = HELDOUT_FRACTION
) -> dict[str, Any]:
    """What names the held-out episodes of these datasets: JSON-compatible.

    ``rule`` and ``fraction`` say how they are chosen, ``count`` how many there are,
    ``fingerprint`` is the hash of their identities and lengths, ``numbers`` lists them for each
    dataset (null where they are more than `LISTED`).

    Raises:
        DataError: none is held out.
    """
    heldout = EpisodeIndex.of(readers, "heldout", fraction)
    numbers = [heldout.number[heldout.dataset == d].tolist() for d in range(len(readers))]
    return {
        "rule": RULE,
        "fraction": fraction,
        "count": len(heldout),
        "fingerprint": heldout.fingerprint,
        "numbers": numbers if len(heldout) <= LISTED else None,
    }
