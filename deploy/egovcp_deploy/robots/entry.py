"""Entry points of the commands beside `egovcp-deploy`: a missing package is one clear line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from egovcp.errors import EnvironmentFailure


def fake_g1(argv: Sequence[str] | None = None) -> int:
    """`egovcp-fake-g1`."""
    return _run("egovcp_deploy.robots.fake.command", "egovcp-fake-g1", argv)


def depth_server(argv: Sequence[str] | None = None) -> int:
    """`egovcp-depth-server`."""
    return _run("egovcp_deploy.robots.depth_server", "egovcp-depth-server", argv)


def _run(module: str, command: str, argv: Sequence[str] | None) -> int:
    try:
        main: Callable[[Sequence[str] | None], int] = import_module(module).main
    except ModuleNotFoundError as error:
        print(
            f"{command}: error: {error.name} is not installed here; "
            "install it: pip install 'egovcp-deploy[sim]'",
            file=sys.stderr,
        )
        return EnvironmentFailure.exit_code
    return main(argv)
