"""Writes whole episodes as a LeRobot v3.0 dataset, straight to parquet.

Files are written to a temporary folder beside the destination, which is renamed when it is
complete: an interrupted run leaves no incomplete dataset. A collection that must survive a crash
uses `egovcp.data.committer` instead.
"""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Self

from egovcp.data import schema
from egovcp.data.destination import make_parent, require_new, resolve_root
from egovcp.data.episode import Episode
from egovcp.data.provenance import Provenance
from egovcp.data.staging import encode
from egovcp.data.version import VersionContents, VersionWriter, publish
from egovcp.errors import UsageError


class DatasetWriter:
    """Adds episodes one by one; `finalize` moves the dataset to ``root``.

    As a context manager it finalizes on success and discards everything on an error.
    """

    def __init__(
        self, root: str | Path, provenance: Provenance, shard_episodes: int = schema.SHARD_EPISODES
    ) -> None:
        """Create the temporary folder.

        Raises:
            UsageError: ``root`` exists and is not an empty folder, or cannot exist.
            EnvironmentFailure: ``root`` is a mount point.
        """
        self.root = resolve_root(root)
        require_new(self.root)
        make_parent(self.root)
        folder = self.root.with_name(f".{self.root.name}.{secrets.token_hex(4)}.partial")
        self._version = VersionWriter(folder, provenance, VersionContents(shard_episodes))

    @property
    def num_episodes(self) -> int:
        """Episodes added so far."""
        return self._version.episodes

    @property
    def num_frames(self) -> int:
        """Frames added so far."""
        return self._version.frames

    def add(self, episode: Episode) -> None:
        """Validate and append a complete episode (see `Episode.validate`)."""
        self._version.add(encode(episode, f"episode {self.num_episodes}"))

    def finalize(self) -> Path:
        """Complete the files, move the folder to ``root`` and return it.

        Raises:
            UsageError: no episode was added, or ``root`` was created by another program.
        """
        try:
            if self.num_episodes == 0:
                raise UsageError(f"no episode was written to {self.root}")
            self._version.close()
            publish(self._version.folder, self.root)
        except BaseException:
            self.discard()
            raise
        return self.root

    def discard(self) -> None:
        """Remove everything written so far."""
        self._version.discard()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.finalize()
        else:
            self.discard()
