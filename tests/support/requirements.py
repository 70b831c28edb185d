"""Which distributions an installed one requires."""

from __future__ import annotations

from functools import cache
from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


@cache
def required_distributions(distribution: str) -> frozenset[str]:
    """Names of a distribution without extras and of all that it requires, recursively."""
    found: set[tuple[str, str]] = set()

    def add(name: str, extra: str) -> None:
        if (name, extra) in found:
            return
        try:
            texts = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            return
        found.add((name, extra))
        for requirement in map(Requirement, texts):
            if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
                for inner in ("", *requirement.extras):
                    add(canonicalize_name(requirement.name), inner)

    add(canonicalize_name(distribution), "")
    return frozenset(name for name, _ in found)
