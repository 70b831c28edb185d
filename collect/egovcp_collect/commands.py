"""Entry points of the console commands. Nothing else is imported here: see `EntryPoint`."""

from egovcp.entry_point import EntryPoint

collect = EntryPoint("egovcp-collect", "egovcp_collect.collect")
dataset = EntryPoint("egovcp-dataset", "egovcp_collect.dataset.cli")
