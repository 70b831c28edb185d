"""Finds missing optional packages and the command that installs them.

The extras come from the metadata of the installed distributions.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from importlib import import_module, metadata
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any, Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from egovcp.errors import EnvironmentFailure

#: Top-level module -> the distribution that contains it, where the names differ.
DISTRIBUTIONS: Final = MappingProxyType(
    {
        "mcap_ros2": "mcap-ros2-support",
        "mpl_toolkits": "matplotlib",
        "PIL": "pillow",
        "rerun": "rerun-sdk",
        "rsl_rl": "rsl-rl-lib",
        "sklearn": "scikit-learn",
        "yaml": "pyyaml",
        "zmq": "pyzmq",
    }
)
#: Imports of datasets: the extra `egovcp[data]`.
DATA_MODULES: Final = ("filelock", "pandas", "PIL", "pyarrow")
#: Imports of the simulator: the extra `egovcp[sim]`.
SIMULATOR_MODULES: Final = ("mjlab", "mujoco")


class MissingPackage(EnvironmentFailure):
    """An optional package is not installed."""


def distribution_of(module: str) -> str:
    """The distribution that contains a module: ``PIL.Image`` -> ``pillow``."""
    top = module.partition(".")[0]
    return canonicalize_name(DISTRIBUTIONS.get(top, top))


def versions_of(distributions: Iterable[str]) -> dict[str, str]:
    """Distribution -> installed version."""
    return {name: metadata.version(name) for name in distributions}


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
    """The error for a failed import; None if the package is installed or the standard library's.

    For the arguments see `require_packages`; ``distribution`` may be one of its modules.
    """
    top = (error.name or "").partition(".")[0]
    if not top or top in sys.stdlib_module_names or is_installed(top):
        return None
    return MissingPackage(_message(distribution_of(distribution), purpose, [top]))


def install_command(distribution: str, *packages: str) -> str:
    """The command that installs packages: the smallest extra that has them all, of the distribution
    or else of egovcp; the packages themselves if there is none."""
    wanted = {canonicalize_name(package) for package in packages}
    for owner in (canonicalize_name(distribution), "egovcp"):
        fitting = {name: has for name, has in _extras(owner).items() if wanted <= has}
        if fitting:
            return f"pip install '{owner}[{min(fitting, key=lambda name: len(fitting[name]))}]'"
    return f"pip install {' '.join(sorted(wanted))}"


def _message(distribution: str, purpose: str, modules: list[str]) -> str:
    packages = [distribution_of(module) for module in modules]
    verb = "which is" if len(packages) == 1 else "which are"
    return (
        f"{purpose} needs {' and '.join(packages)}, {verb} not installed; install it: "
        f"{install_command(distribution, *packages)}"
    )


def _extras(distribution: str) -> dict[str, set[str]]:
    """Name of each extra -> its packages."""
    try:
        names = metadata.metadata(distribution).get_all("Provides-Extra") or []
    except metadata.PackageNotFoundError:
        return {}
    return {name: _packages_of(distribution, name) for name in names}


def _packages_of(distribution: str, extra: str) -> set[str]:
    """The packages of an extra, also of those of egovcp in it."""
    found: set[str] = set()
    for requirement in map(Requirement, metadata.requires(distribution) or []):
        if requirement.marker is not None and requirement.marker.evaluate({"extra": extra}):
            found.add(canonicalize_name(requirement.name))
            if requirement.name == "egovcp":
                for name in requirement.extras:
                    found |= _packages_of("egovcp", name)
    return found


def import_class[T](reference: str, base: type[T], known_as: str) -> type[T]:
    """The subclass of ``base`` at ``package.module:Class``; ``known_as`` is its public name.

    Raises:
        ValueError: the reference has another form, or names something else.
        ImportError, AttributeError, ...: whatever the import raises.
    """
    module, colon, name = reference.partition(":")
    if not (module and colon and name):
        raise ValueError(f"{reference!r} is no reference; expected package.module:Class")
    found: Any = import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ValueError(f"{reference} is no subclass of {known_as}")
    return found
