"""Finds missing optional packages and the command that installs them.

The extras come from the metadata of the installed distributions.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
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
    """The error for a failed import; None if the module is our own or the standard library's.

    For the arguments see `require_packages`; ``distribution`` may be one of its modules.
    """
    top = (error.name or "").partition(".")[0]
    own = distribution_of(top) in _OWN or top.startswith("egovcp_")
    if not top or own or top in sys.stdlib_module_names or is_installed(top):
        return None
    return MissingPackage(_message(distribution_of(distribution), purpose, [top]))


def install_command(distribution: str, *packages: str) -> str:
    """The command that installs packages, by the extra with the most of them if there is one.

    Prefers extras of the distribution itself to those of its dependencies, and small extras.
    """
    distribution = canonicalize_name(distribution)
    wanted = {canonicalize_name(package) for package in packages}

    def preference(option: tuple[str, frozenset[str]]) -> tuple[int, bool, int]:
        name, contents = option
        return len(wanted & contents), name.partition("[")[0] == distribution, -len(contents)

    best, contents = max(_installable(distribution), key=preference)
    targets = [f"'{best}'" if "[" in best else best] if wanted & contents else []
    return " ".join(["pip install", *targets, *sorted(wanted - contents)])


def _message(distribution: str, purpose: str, modules: list[str]) -> str:
    packages = [distribution_of(module) for module in modules]
    verb = "which is" if len(packages) == 1 else "which are"
    return (
        f"{purpose} needs {' and '.join(packages)}, {verb} not installed; install it: "
        f"{install_command(distribution, *packages)}"
    )


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
    with suppress(metadata.PackageNotFoundError):
        found = [Requirement(text) for text in metadata.requires(distribution) or []]
        return [r for r in found if r.marker is None or r.marker.evaluate({"extra": extra})]
    return []


def _extras(distribution: str) -> list[str]:
    with suppress(metadata.PackageNotFoundError):
        return sorted(metadata.metadata(distribution).get_all("Provides-Extra") or [])
    return []


def _is_own(distribution: str) -> bool:
    return distribution in _OWN or distribution.startswith("egovcp-")


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
