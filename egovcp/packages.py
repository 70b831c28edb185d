"""Optional packages: which of them are missing, and which command installs them.

Extras are read from the metadata of the installed distributions, so that a message never names one
that does not exist.
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
        "zmq": "pyzmq",
    }
)
#: What reading and writing datasets imports: the extra `egovcp[data]`.
DATA_MODULES: Final = ("filelock", "pandas", "PIL", "pyarrow")
#: What the simulator imports: the extra `egovcp[sim]`.
SIMULATOR_MODULES: Final = ("mjlab", "mujoco")
#: Our own distributions. The extras of no others are searched.
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
    """Refuse work that needs modules which are not installed.

    Args:
        distribution: the distribution whose extras are named, such as ``egovcp-deploy``.
        purpose: what needs them, the subject of the message, such as ``--wandb.enable``.
        modules: top-level modules.

    Raises:
        MissingPackage: names all that are missing, and the command that installs them.
    """
    missing = [module for module in modules if not is_installed(module)]
    if missing:
        raise MissingPackage(_message(distribution, purpose, missing))


def missing_package(
    error: ModuleNotFoundError, distribution: str, purpose: str
) -> MissingPackage | None:
    """A failed import as an error of the user's environment.

    Args:
        error: the failed import.
        distribution: see `require_packages`; the module that was imported may be given, too.
        purpose: see `require_packages`.

    Returns:
        The error; None if the module is our own or the standard library's: then it is a bug.
    """
    top = (error.name or "").partition(".")[0]
    own = distribution_of(top) in _OWN or top.startswith("egovcp_")
    if not top or own or top in sys.stdlib_module_names or is_installed(top):
        return None
    return MissingPackage(_message(distribution_of(distribution), purpose, [top]))


def install_command(distribution: str, *packages: str) -> str:
    """The command that installs packages as the extra of a distribution that needs them.

    If several extras do, its smallest is named, then one of those of our distributions that it
    depends on. A package that none of them contains is named itself.
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
    """What to install, and which of the wanted packages that brings."""
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
    """(``NAME`` or ``NAME[EXTRA]``, what it brings), of a distribution and our own below it."""
    plain = _closure(distribution, "")
    own = [distribution, *sorted(name for name in plain if _is_own(name) and name != distribution)]
    for name in own:
        yield name, _closure(name, "")
        for extra in _extras(name):
            yield f"{name}[{extra}]", _closure(name, extra)


@cache
def _closure(distribution: str, extra: str) -> frozenset[str]:
    """Distributions that ``distribution[extra]`` names, and those that our own among them name."""
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
    """What it requires here, with that extra or, if it is empty, without any."""
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
