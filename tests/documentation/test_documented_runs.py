"""Documented commands and Python snippets do what the page says, at a reduced size."""

import glob
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from huggingface_hub import HfApi

from egovcp.log.viewer import LiveRerun, Viewer
from tests.support.hub import FakeHub, redirect_hub
from tests.support.ports import free_port

from .markdown import DocumentedCommand, Text
from .programs import ROOT, main_of
from .test_documented_commands import COMMANDS, PAGES, complete, is_result

_SHORT = [
    "--env.controller=walk",
    *(f"--env.{task}_episode.ticks=12" for task in ("ball", "wall", "arch")),
    *(f"--env.{task}_episode.event_ticks=[2,3]" for task in ("ball", "wall", "arch")),
]
_TRAIN = shlex.split(
    "--preset=debug --steps=1 --batch_size=2 --sampling.length=6 "
    "--eval_freq=0 --tensorboard=false --threads=1 "
    "--device=cpu --planner.samples=16 --planner.elites=4"
)
#: Program -> options that follow the documented ones, and so replace them where they are the same.
_REDUCED = {
    "egovcp-collect": ["--episodes=1", "--num_workers=1", "--num_envs=1", *_SHORT],
    "egovcp-dataset": [],
    "egovcp-deploy": ["--episodes=1", "--log.videos=0", *_SHORT],
    "egovcp-eval": ["--episodes=1", "--num_workers=1", "--num_envs=1", *_SHORT],
    "egovcp-eval-model": ["--device=cpu", "--pictures=false"],
    "egovcp-mcap": [],
    "egovcp-train": _TRAIN,
}
#: The end of a range of episodes, of which the prepared datasets have four.
_EPISODES = re.compile(r"(episodes[=:] ?\"?0:)\d+")
#: Run elsewhere, or too long: part of a command line -> where it is tested.
_ELSEWHERE = {
    "--robot.type=unitree_g1": "tests/deploy/robots/test_fake_command.py",
    "--controllers=planner,ppo": "tests/experiment/experiments/test_ppo.py",
    "--mapping": "tests/deploy/mcap/test_topics.py",
    "egovcp-task": "tests/deploy/test_task.py",
    "--task=bag": "tests/test_examples.py",
    "--task=arm_task": "tests/test_examples.py",
    "data/bag": "tests/test_examples.py",
    "data/arm": "tests/test_examples.py",
    "--features=": "tests/train/test_features.py",
}
#: Repository on the fake Hub -> folder.
_PUBLISHED = {
    "me/contact": "data/contact",
    **{f"me/egovcp-{task}": f"data/{task}" for task in ("ball", "wall")},
    **{f"egovcp/{task}": f"data/{task}" for task in ("ball", "wall", "arch")},
}


def test_commands_tested_elsewhere_name_a_test_that_exists() -> None:
    assert not [p for p in _ELSEWHERE.values() if not (ROOT / p).exists()]


def runnable() -> list[DocumentedCommand]:
    """Complete commands of ours; one of those that have the same flags."""
    distinct: dict[tuple[str, ...], DocumentedCommand] = {}
    for command in COMMANDS:
        line = " ".join(command.argv)
        if (
            is_result(command)
            or command.argv[0] not in _REDUCED
            or len(command.argv) < 3
            or "..." in line
            or any(part in line for part in _ELSEWHERE)
            or command.inline
        ):
            continue
        flags = sorted(arg.partition("=")[0] for arg in command.argv if arg.startswith("-"))
        distinct.setdefault((*command.argv[:1], _subcommand(command), *flags), command)
    return list(distinct.values())


def _subcommand(command: DocumentedCommand) -> str:
    return "" if command.argv[1].startswith("-") else command.argv[1]


@pytest.fixture(scope="module")
def published(prepared: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A Hub with the datasets that pages name."""
    place = tmp_path_factory.mktemp("hub")
    with FakeHub(place / "hub") as hub, redirect_hub(hub.endpoint, place / "home"):
        api = HfApi(endpoint=hub.endpoint, token="hf_any")
        for repository, folder in _PUBLISHED.items():
            api.create_repo(repository, repo_type="dataset")
            api.upload_folder(
                repo_id=repository, folder_path=prepared / folder, repo_type="dataset"
            )
            api.create_tag(repository, tag="v3.0", repo_type="dataset")
        yield


@pytest.fixture
def sandbox(
    prepared: Path, tmp_path: Path, published: None, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A copy of the prepared folder, which is the working directory."""
    folder = Path(shutil.copytree(prepared, tmp_path / "work"))
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HF_TOKEN", "hf_any")
    monkeypatch.setattr(LiveRerun, "of", _viewer_at_free_ports)
    return folder


def _viewer_at_free_ports(words: str) -> LiveRerun:
    """`LiveRerun.of`, beside whatever runs on this machine."""
    return LiveRerun(words, Viewer(f"rerun+http://127.0.0.1:{free_port()}/proxy"), free_port())


@pytest.mark.parametrize("command", runnable(), ids=lambda c: f"{c.place}-{c.argv[0]}")
def test_a_documented_command_succeeds(command: DocumentedCommand, sandbox: Path) -> None:
    program, *args = complete(command.argv)
    _remove_outputs(program, args)
    args = [_EPISODES.sub(r"\g<1>4", arg) for arg in args]
    args = [path for arg in args for path in (sorted(glob.glob(arg)) or [arg])]
    if program == "egovcp-eval" and not any(arg.startswith("--controllers=") for arg in args):
        args.append("--controllers=planner,hold")  # `constant` searches for long
    assert main_of(program)([*args, *_REDUCED[program]]) == 0


def _remove_outputs(program: str, args: list[str]) -> None:
    """Remove what the command is to write, as on the machine of somebody who follows the page."""
    outputs = ["--output_dir"]
    if program == "egovcp-collect" or args[0] == "to-dataset":
        outputs.append("--dataset.root")
    for flag, _, value in (arg.partition("=") for arg in args):
        if flag in outputs:
            shutil.rmtree(value, ignore_errors=True)


def snippets() -> list[Text]:
    """Python of every page; one of those that differ in the task alone."""
    distinct = {
        re.sub("ball|wall|arch", "TASK", text.body): text
        for page in PAGES.values()
        for text in page.python
    }
    return list(distinct.values())


@pytest.mark.parametrize("snippet", snippets(), ids=lambda text: text.place)
def test_a_python_snippet_runs(snippet: Text, sandbox: Path) -> None:
    exec(compile(snippet.body, snippet.place, "exec"), {"__name__": "snippet"})
