"""Type of the fixture `arguments` in `tests/train`."""

from collections.abc import Callable

type Arguments = Callable[..., list[str]]
"""Output folder, further flags, and options by keyword -> flags of a run of `egovcp-train`."""
