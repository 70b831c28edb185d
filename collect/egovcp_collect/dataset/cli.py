"""`egovcp-dataset`: inspect, check, repair and share datasets."""

from typing import Final

from egovcp.subcommands import CommandGroup, Subcommand

_PACKAGE: Final = "egovcp_collect.dataset"
_DATASET: Final = ("dataset",)
COMMANDS: Final = CommandGroup(
    "egovcp-dataset",
    "Inspect, check, repair, join and share datasets in LeRobot's format.",
    {
        name: Subcommand(f"{_PACKAGE}.{function}", summary, _DATASET, more)
        for name, function, summary, more in (
            ("info", "info:run_info", "print tasks, episodes, hours and provenance", ""),
            ("check", "check:run_check", "read all files and frames; list the first problems", ""),
            ("repair", "rewrite:run_repair", "write the readable episodes to a new dataset", ""),
            (
                "delete",
                "edit:run_delete",
                "copy the dataset without some episodes to a new folder",
                "",
            ),
            ("split", "edit:run_split", "split the dataset at random into several", ""),
            ("merge", "rewrite:run_merge", "join datasets of the same controller", "others"),
            (
                "coverage",
                "coverage:run_coverage",
                "report and assess events, returns and actions",
                "",
            ),
            ("card", "card:run_card", "write the dataset card, README.md, with plots", ""),
            ("viz", "viz:run_viz", "write an episode as a Rerun or MCAP recording", ""),
            ("push", "hub:run_push", "publish data and card in one commit, and tag it", ""),
            ("pull", "hub:run_pull", "download one commit from the Hub to a new folder", ""),
        )
    },
    "DATASET: a folder, else a Hub id user/name (LeRobot's local copy, if there is one). push, "
    "repair and the OTHERS of merge take folders only; pull takes a Hub id.",
)
main = COMMANDS.main
