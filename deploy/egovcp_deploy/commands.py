"""Entry points of the console commands. This module imports no other one of the package."""

from __future__ import annotations

from typing import Final

from egovcp.entry_point import EntryPoint

deploy: Final = EntryPoint("egovcp-deploy", "egovcp_deploy.deploy")
evaluate: Final = EntryPoint("egovcp-eval", "egovcp_deploy.evaluate")
compare: Final = EntryPoint("egovcp-compare", "egovcp_deploy.compare")
fake_g1: Final = EntryPoint("egovcp-fake-g1", "egovcp_deploy.robots.fake.command")
depth_server: Final = EntryPoint("egovcp-depth-server", "egovcp_deploy.robots.depth_server")
mcap: Final = EntryPoint("egovcp-mcap", "egovcp_deploy.mcap.cli")
