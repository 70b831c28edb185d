"""``torch.compile`` with a cache folder that other users cannot write to."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from functools import cache
from typing import Final

import torch
from torch import Tensor

from egovcp.errors import EnvironmentFailure
from egovcp.plan.backends.library import OTHERWISE
from egovcp.trusted_cache import TrustedCache, user_cache_folder

_FOLDER: Final = "TORCHINDUCTOR_CACHE_DIR"


def compiled(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """``torch.compile(function)``; the first call compiles.

    Raises:
        EnvironmentFailure: when called, if it cannot be compiled here; at once, if another user
            can write to the cache folder.
    """
    _choose_cache_folder()
    fast = torch.compile(function, dynamic=False)

    def call(*args: Tensor | None) -> Tensor:
        try:
            result: Tensor = fast(*args)
        except (RuntimeError, OSError) as error:
            reason = " ".join(str(error).partition("\n")[0].split())[:300]
            raise EnvironmentFailure(f"torch.compile failed: {reason}; {OTHERWISE}") from error
        return result

    return call


@cache
def _choose_cache_folder() -> None:
    """Torch's default is ``/tmp/torchinductor_USER``, which another user may have created with
    libraries in it, and which a user id without an account does not have."""
    if os.environ.get(_FOLDER):
        return
    folder = user_cache_folder()
    if folder is not None:
        try:
            with TrustedCache(folder / "torchinductor") as cache:
                os.environ[_FOLDER] = str(cache.folder)
                return
        except OSError:
            pass  # it cannot be created: a folder of this process serves
    os.environ[_FOLDER] = tempfile.mkdtemp(prefix="egovcp-torchinductor-")
