"""Seals and commits synthetic episodes until it is killed, and says what is safe.

``python committing_process.py ROOT``
"""

import sys
from pathlib import Path

from egovcp.data import Provenance
from egovcp.data.committer import open_committer
from egovcp.data.staging import encode
from egovcp.testing import random_episode


def main(root: Path) -> None:
    sealed: set[int] = set()
    with open_committer(root, Provenance("stance-1"), 3, lambda provenance: None) as committer:
        for number in committer.missing(100_000):
            episode = random_episode(number, length=4)
            committer.staging.put(number, encode(episode))
            committer.mark_staged(number)
            sealed.add(number)
            print("sealed", number, flush=True)
            if committer.next_shard_is_complete:
                committer.commit()
                print("committed", committer.committed, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
