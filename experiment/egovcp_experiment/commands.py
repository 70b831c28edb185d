"""Entry points of the console commands. This module imports no other one of the package."""

from __future__ import annotations

from typing import Final

from egovcp.entry_point import EntryPoint

experiment: Final = EntryPoint("egovcp-experiment", "egovcp_experiment.command")
