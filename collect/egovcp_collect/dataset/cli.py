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
            ("check", "check:run_check", "read every file and frame; list all problems", ""),
            ("repair", "rewrite:run_repair", "write the readable episodes to a new dataset", ""),
            ("delete", "edit:run_delete", "write it without some episodes to a new folder", ""),
            ("split", "edit:run_split", "split it at random into several datasets", ""),
            ("merge", "rewrite:run_merge", "join datasets of the same controller", "others"),
            ("coverage", "coverage:run_coverage", "report events, returns, actions; assess it", ""),
            ("card", "card:run_card", "write its dataset card, README.md, with plots", ""),
            ("viz", "viz:run_viz", "show an episode in Rerun, or write it as MCAP", ""),
            ("push", "hub:run_push", "publish it on the Hub: data, card and tags, one commit", ""),
            ("pull", "hub:run_pull", "download one commit from the Hub to a new folder", ""),
        )
    },
    "DATASET is a folder, or an id of the Hub (user/name) where no such folder exists.",
)
main = COMMANDS.main
