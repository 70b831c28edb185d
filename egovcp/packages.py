"""Finds missing optional packages and the command that installs them.

The extras come from the metadata of the installed distributions.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from types import MappingProxyType
from typing import Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from egovcp.errors import EnvironmentFailure

#: Top-level module -> the distribution that contains it, where the names differ.
DISTRIBUTIONS: Final = MappingProxyType(
    {
        "mcap_ros2": "mcap-ros2-support",
        "PIL": "pillow",
        "rerun": "rerun-sdk",
        "rsl_rl": "rsl-rl-lib",
        "sklearn": "scikit-learn",
        "zmq": "pyzmq",
    }
)
#: Imports of datasets: the extra `egovcp[data]`.
DATA_MODULES: Final = ("filelock", "pandas", "PIL", "pyarrow")
#: Imports of the simulator: the extra `egovcp[sim]`.
SIMULATOR_MODULES: Final = ("mjlab", "mujoco")
#: Our own distributions, whose extras are searched.
_OWN: Final = ("egovcp", "lerobot-env-egovcp", "lerobot-policy-egovcp", "lerobot-robot-egovcp")


class MissingPackage(EnvironmentFailure):
    """An optional package is not installed."""


def distribution_of(module: str) -> str:
    """The distribution that contains a module: ``PIL.Image`` -> ``pillow``."""
    top = module.partition(".")[0]
    return canonicalize_name(DISTRIBUTIONS.get(top, top))


def is_installed(module: str) -> bool:
    """Whether a top-level module can be imported."""
    try:
        return find_spec(module) is not None
    except ValueError:  # in `sys.modules` without a spec
        return sys.modules.get(module) is not None


def require_packages(distribution: str, purpose: str, *modules: str) -> None:
    """Raise unless modules are installed.

    Args:
        distribution: the distribution with the extras, such as ``egovcp-deploy``.
        purpose: subject of the message, such as ``--wandb.enable``.
        modules: top-level modules.

    Raises:
        MissingPackage: names the missing packages and the command that installs them.
    """
    missing = [module for module in modules if not is_installed(module)]
    if missing:
        raise MissingPackage(_message(distribution, purpose, missing))


def missing_package(
    error: ModuleNotFoundError, distribution: str, purpose: str
) -> MissingPackage | None:
    """The error for a failed import; None if the module is our own or the standard library's.

    Args:
        distribution: see `require_packages`, or the name of the imported module.
        purpose: see `require_packages`.
    """
    top = (error.name or "").partition(".")[0]
    own = distribution_of(top) in _OWN or top.startswith("egovcp_")
    if not top or own or top in sys.stdlib_module_names or is_installed(top):
        return None
    return MissingPackage(_message(distribution_of(distribution), purpose, [top]))


def install_command(distribution: str, *packages: str) -> str:
    """The command that installs packages as an extra of a distribution.

    Prefers extras of the distribution itself to those of its dependencies, and small extras. A
    package in no extra is installed by its name.
    """
    wanted = {canonicalize_name(package) for package in packages}
    targets: list[str] = []
    while wanted:
        found, names = _best(canonicalize_name(distribution), frozenset(wanted))
        targets.append(f"'{found}'" if "[" in found else found)
        wanted -= names
    return f"pip install {' '.join(targets)}"


def _message(distribution: str, purpose: str, modules: list[str]) -> str:
    packages = [distribution_of(module) for module in modules]
    verb = "which is" if len(packages) == 1 else "which are"
    return (
        f"{purpose} needs {' and '.join(packages)}, {verb} not installed; install it: "
        f"{install_command(distribution, *packages)}"
    )


def _best(distribution: str, wanted: frozenset[str]) -> tuple[str, frozenset[str]]:
    """(what to install, the wanted packages that it contains)."""
    options = [
        (name, wanted & brought, len(brought)) for name, brought in _installable(distribution)
    ]
    options = [option for option in options if option[1]]
    if not options:
        package = min(wanted)
        return package, frozenset({package})
    most = max(len(names) for _, names, _ in options)

    def preference(option: tuple[str, frozenset[str], int]) -> tuple[bool, int]:
        name, _, size = option
        return name.partition("[")[0] != distribution, size

    name, names, _ = min((o for o in options if len(o[1]) == most), key=preference)
    return name, names


def _installable(distribution: str) -> Iterator[tuple[str, frozenset[str]]]:
    """(``NAME`` or ``NAME[EXTRA]``, its packages), of a distribution and its own dependencies."""
    plain = _closure(distribution, "")
    own = [distribution, *sorted(name for name in plain if _is_own(name) and name != distribution)]
    for name in own:
        yield name, _closure(name, "")
        for extra in _extras(name):
            yield f"{name}[{extra}]", _closure(name, extra)


@cache
def _closure(distribution: str, extra: str) -> frozenset[str]:
    """Direct requirements of ``distribution[extra]``, and those of our own distributions in it."""
    found = {distribution}
    for requirement in _requirements(distribution, extra):
        name = canonicalize_name(requirement.name)
        found.add(name)
        if _is_own(name):
            for inner in ("", *sorted(requirement.extras)):
                if (name, inner) != (distribution, extra):
                    found |= _closure(name, inner)
    return frozenset(found)


def _requirements(distribution: str, extra: str) -> list[Requirement]:
    """Requirements on this platform with an extra; empty: without extras."""
    try:
        declared = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        return []
    requirements = [Requirement(text) for text in declared]
    return [r for r in requirements if r.marker is None or r.marker.evaluate({"extra": extra})]


def _extras(distribution: str) -> list[str]:
    try:
        found = metadata.metadata(distribution).get_all("Provides-Extra")
    except metadata.PackageNotFoundError:
        return []
    return sorted(found or [])


def _is_own(distribution: str) -> bool:
    return distribution in _OWN or distribution.startswith("egovcp-")
