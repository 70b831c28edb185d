"""The Ray cluster of ``RAY_ADDRESS``, or one that is started on this machine for the occasion.

Ray is optional: nothing imports it before somebody asks for a cluster.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

from egovcp.errors import EnvironmentFailure
from egovcp.packages import require_packages


def ray_package(distribution: str) -> Any:
    """The package `ray`.

    Args:
        distribution: whose extra `ray` installs it.

    Raises:
        EnvironmentFailure: it is not installed.
    """
    require_packages(distribution, "--backend=ray", "ray")
    return importlib.import_module("ray")


def connect(distribution: str) -> Any:
    """Join the cluster; gives the package, whose ``shutdown`` leaves it again.

    Raises:
        EnvironmentFailure: Ray is not installed, or the cluster cannot be reached.
    """
    ray = ray_package(distribution)
    address = os.environ.get("RAY_ADDRESS")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported home
    own = {} if address else {"include_dashboard": False, "_node_ip_address": "127.0.0.1"}
    try:
        ray.init(address, log_to_driver=False, logging_level="warning", **own)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise EnvironmentFailure(
            f"cannot reach the Ray cluster at {address or 'this machine'}: {error}; check "
            "RAY_ADDRESS"
        ) from error
    return ray
