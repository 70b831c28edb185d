"""`egovcp-mcap`: inspect recorded runs, recover truncated ones, convert them to datasets."""

from typing import Final

from egovcp.subcommands import CommandGroup, Subcommand

COMMANDS: Final = CommandGroup(
    "egovcp-mcap",
    "Inspect recorded runs (MCAP), recover truncated ones, convert them to datasets.",
    {
        "info": Subcommand(
            "egovcp_deploy.mcap.info:run",
            "its content: run, ticks, rates, topics, gaps; complete or truncated",
            ("file",),
        ),
        "recover": Subcommand(
            "egovcp_deploy.mcap.recover:run",
            "copy every complete tick of a truncated file to a new one with an index",
            ("file", "output"),
        ),
        "to-dataset": Subcommand(
            "egovcp_deploy.mcap.to_dataset:run",
            "convert rollouts to a new LeRobot dataset for training (--dataset.root)",
            more="files",
            takes_argv=True,
        ),
    },
)
main = COMMANDS.main
