"""`egovcp-dataset push`: a dataset and its card to the Hub, in one commit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from tqdm import tqdm

from egovcp.checks import check_dataset
from egovcp.data import DatasetConfig, DatasetReader, schema
from egovcp.data.committer import work_folder
from egovcp.errors import DataError, UsageError
from egovcp.hub import Content, Publication, PublishConfig, Published, is_repo_id, publish
from egovcp.outputs import write_report
from egovcp.terminal import echo
from egovcp_collect.dataset.card import ASSETS, CARD, card_text

#: Folders of a LeRobot dataset: whatever else lies in them on the Hub is of an earlier version.
_OWNED: Final = ("data", "meta", "videos", "images", ASSETS)


@dataclass(frozen=True)
class PushConfig(PublishConfig):
    """Publish a dataset and its card on the Hub in one commit, and tag it for LeRobot.

    The dataset is checked first. A push that failed can be repeated: it completes what is
    missing, and commits nothing if nothing differs.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder on disk."""
    branch: str = "main"
    """Branch; made if need be. LeRobot's version tag follows `main` alone."""
    message: str = ""
    """Title of the commit; empty: what the dataset holds."""


CONFIG = PushConfig


def run(config: PushConfig) -> None:
    """Check, publish, and say how to use it.

    Raises:
        UsageError: the folder or the id is missing or wrong.
        DataError: the dataset is damaged, or its collection has not ended.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    _require_names(config)
    reader = DatasetReader.open(config.dataset)
    _require_finished(reader.root)
    contents = _contents(reader.root)
    _require_sound(reader.root)
    card = Content(card_text(reader, config.repo_id).encode())
    published = publish(
        Publication(
            repo_id=config.repo_id,
            contents={**contents, CARD: card},
            message=config.message or _message(reader),
            owned=_OWNED,
            branch=config.branch,
            private=config.private,
            moving_tag=schema.CODEBASE_VERSION if config.branch == "main" else "",
            tag=config.tag,
        ),
        config.network,
    )
    _report(config, published)


def _require_names(config: PushConfig) -> None:
    if not config.dataset.root:
        raise UsageError("push takes the folder of a dataset; fetch one with `pull` first")
    if not is_repo_id(config.repo_id):
        raise UsageError(f"--repo_id={config.repo_id!r}: expected user/name, where to publish")


def _require_finished(root: Path) -> None:
    work = work_folder(root)
    if work.exists():
        raise DataError(
            f"the collection of {root} has not ended ({work} is there); let it end, or complete "
            "it with `egovcp-collect --resume`"
        )


def _contents(root: Path) -> dict[str, Content]:
    """Every file but hidden ones, the card, and where the folder came from."""
    found: dict[str, Content] = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root)
        if any(part.startswith(".") for part in name.parts):
            continue
        if path.is_symlink():
            raise DataError(f"{path} is a link; a dataset to publish holds plain files")
        if path.is_file() and name.as_posix() not in (CARD, schema.SOURCE_PATH):
            found[name.as_posix()] = Content(path)
    return found


def _require_sound(root: Path) -> None:
    with _progress() as progress:
        check_dataset(DatasetConfig(root=str(root)), progress)


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    with tqdm(desc="checking", unit="ep", delay=1) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def _message(reader: DatasetReader) -> str:
    tasks = sorted({reader.task(i) for i in range(len(reader))})
    return f"{len(reader)} episodes, {reader.num_frames} steps: {', '.join(tasks)}"


def _report(config: PushConfig, published: Published) -> None:
    name, commit = config.repo_id, published.commit
    echo(f"{name}@{config.branch} {'is now' if published.new else 'was already'} {commit}")
    echo(f"egovcp-train --dataset.repo_id={name} --dataset.revision={commit}")
    facts = {"repo_id": name, "branch": config.branch, "tag": config.tag, **asdict(published)}
    write_report(config.json, facts)
