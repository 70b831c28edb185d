"""Entry points of the console commands. Nothing else is imported here: see `EntryPoint`."""

from egovcp.entry_point import EntryPoint

experiment = EntryPoint("egovcp-experiment", "egovcp_experiment.command")
