"""Points Hugging Face's libraries at a fake Hub: another process, or this one."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock


def hub_environment(endpoint: str, home: Path) -> dict[str, str]:
    """Variables for a process that is to talk to the Hub at ``endpoint``.

    ``home`` takes every cache, so that nothing of the user's is read or written. They must
    be set before the process imports a library of Hugging Face.
    """
    return {
        "HF_ENDPOINT": endpoint,
        "HF_HOME": str(home / "huggingface"),
        "HF_HUB_CACHE": str(home / "huggingface/hub"),
        "HF_DATASETS_CACHE": str(home / "huggingface/datasets"),
        "HF_LEROBOT_HOME": str(home / "lerobot"),
        "HF_TOKEN_PATH": str(home / "huggingface/token"),
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HUB_OFFLINE": "0",
        "NO_PROXY": "127.0.0.1",
        "no_proxy": "127.0.0.1",
    }


@contextlib.contextmanager
def redirect_hub(endpoint: str, home: Path) -> Iterator[None]:
    """Redirect this process, whose libraries have read their variables already.

    Replaces the constants of `huggingface_hub`, and of `datasets` and `lerobot` if they
    are imported, until the block ends. An interrupted download goes on at once, where the
    library waits 1 s.
    """
    import huggingface_hub
    from huggingface_hub import constants, file_download

    variables = hub_environment(endpoint, home)
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.dict("os.environ", variables))
        for name, value in {
            "ENDPOINT": endpoint,
            "HUGGINGFACE_CO_URL_TEMPLATE": endpoint + "/{repo_id}/resolve/{revision}/{filename}",
            "HF_HOME": variables["HF_HOME"],
            "HF_HUB_CACHE": variables["HF_HUB_CACHE"],
            "HF_TOKEN_PATH": variables["HF_TOKEN_PATH"],
            "HF_HUB_DISABLE_XET": True,
            "HF_HUB_OFFLINE": False,
        }.items():
            stack.enter_context(mock.patch.object(constants, name, value))
        no_sleep = mock.Mock(wraps=time, sleep=lambda seconds: None)
        stack.enter_context(mock.patch.object(file_download, "time", no_sleep))
        if (config := sys.modules.get("datasets.config")) is not None:
            stack.enter_context(mock.patch.object(config, "HF_ENDPOINT", endpoint))
        lerobot = Path(variables["HF_LEROBOT_HOME"])
        places = {"HF_LEROBOT_HOME": lerobot, "HF_LEROBOT_HUB_CACHE": lerobot / "hub"}
        for module in [m for n, m in sys.modules.items() if n.startswith("lerobot.datasets.")]:
            for name in places.keys() & vars(module).keys():
                stack.enter_context(mock.patch.object(module, name, places[name]))
        huggingface_hub.HfFileSystem.clear_instance_cache()
        try:
            yield
        finally:
            huggingface_hub.HfFileSystem.clear_instance_cache()
            huggingface_hub.close_session()


@contextlib.contextmanager
def client_factory(factory: Callable[[], Any]) -> Iterator[None]:
    """Let `huggingface_hub` send with the clients of ``factory`` until the block ends."""
    import huggingface_hub
    from huggingface_hub.utils._http import default_client_factory  # there is no public name

    huggingface_hub.set_client_factory(factory)
    try:
        yield
    finally:
        huggingface_hub.set_client_factory(default_client_factory)
