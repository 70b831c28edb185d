"""Entry points of the console commands. Nothing else is imported here: see `EntryPoint`."""

from egovcp.entry_point import EntryPoint

deploy = EntryPoint("egovcp-deploy", "egovcp_deploy.deploy")
demo = EntryPoint("egovcp-demo", "egovcp_deploy.demo")
evaluate = EntryPoint("egovcp-eval", "egovcp_deploy.evaluate")
compare = EntryPoint("egovcp-compare", "egovcp_deploy.compare")
fake_g1 = EntryPoint("egovcp-fake-g1", "egovcp_deploy.robots.fake.command")
depth_server = EntryPoint("egovcp-depth-server", "egovcp_deploy.robots.depth_server")
mcap = EntryPoint("egovcp-mcap", "egovcp_deploy.mcap.cli")
task = EntryPoint("egovcp-task", "egovcp_deploy.task", task_argument=1)
