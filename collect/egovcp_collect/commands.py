"""Entry points of the console commands. This module imports no other one of the package."""

from __future__ import annotations

from typing import Final

from egovcp.entry_point import EntryPoint

collect: Final = EntryPoint("egovcp-collect", "egovcp_collect.collect")
dataset: Final = EntryPoint("egovcp-dataset", "egovcp_collect.dataset.cli")
