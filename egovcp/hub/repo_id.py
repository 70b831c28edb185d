"""Ids of repositories on the Hub, and how an argument that may be a folder or an id is read."""

from __future__ import annotations

import os
import re
from typing import Final

_NAME: Final = r"[A-Za-z0-9_](?:[\w.-]*\w)?"
_REPO_ID: Final = re.compile(rf"{_NAME}/{_NAME}", re.ASCII)
_MAX_LENGTH: Final = 96


def is_repo_id(text: str) -> bool:
    """Whether ``text`` has the form of an id on the Hub, ``user/name``."""
    return (
        len(text) <= _MAX_LENGTH
        and _REPO_ID.fullmatch(text) is not None
        and ".." not in text
        and "--" not in text
        and not text.endswith(".git")
    )


def is_local_path(text: str) -> bool:
    """Whether an argument that may be a folder or a Hub id means a folder, existing or not.

    It does if something of this name exists, if it has not the form of an id, or if its parent is
    an existing folder: ``runs/bal`` beside ``runs/ball`` is a mistyped folder.
    """
    if not is_repo_id(text) or os.path.lexists(text):
        return True
    return os.path.isdir(os.path.dirname(text))
