"""Anything but an artifact as it was written is refused by name, and nothing in it is executed."""

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from egovcp.artifact import CONFIG, WEIGHTS, load_artifact, read_options
from egovcp.errors import ArtifactError
from egovcp.manifest import MANIFEST, PROCESSORS
from egovcp.model import PRESETS

from .conftest import FILES, PLANNER, Json, edit, sign


@pytest.mark.parametrize("name", sorted(FILES))
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ArtifactError, match=name):
        load_artifact(str(folder))


@pytest.mark.parametrize("name", sorted(FILES - {MANIFEST}))
@pytest.mark.parametrize("where", [0, -1])
def test_a_changed_byte_is_noticed(folder: Path, name: str, where: int) -> None:
    content = bytearray((folder / name).read_bytes())
    content[where] ^= 1
    (folder / name).write_bytes(content)
    with pytest.raises(ArtifactError, match=f"{name}.*SHA-256"):
        load_artifact(str(folder))


@pytest.mark.parametrize("word", ["stance-1", "sha256", "schema_version", "files"])
def test_every_change_of_the_manifest_is_noticed(folder: Path, word: str) -> None:
    text = (folder / MANIFEST).read_text()
    assert word in text
    (folder / MANIFEST).write_text(text.replace(word, word.upper(), 1))
    with pytest.raises(ArtifactError, match=MANIFEST):
        load_artifact(str(folder))


def test_an_older_artifact_without_files_for_lerobot_still_loads(folder: Path) -> None:
    for name in PROCESSORS:
        (folder / name).unlink()
    edit(folder / MANIFEST, lambda m: [m["files"].pop(name) for name in PROCESSORS])
    assert load_artifact(str(folder)).planner == PLANNER


@pytest.mark.parametrize("name", sorted(FILES))
def test_a_truncated_file_is_noticed(folder: Path, name: str) -> None:
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(ArtifactError, match=name):
        load_artifact(str(folder))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(schema_version=1), "schema version 1"),
        (lambda m: m.pop("schema_version"), "schema version null"),
        (lambda m: m["features"].update(planner_hz=50), "another feature spec.*planner_hz"),
        (lambda m: m["features"]["action_box"].update(low=[0] * 7), "feature spec.*action_box"),
        (lambda m: m["features"]["state_names"].pop(), "feature spec.*state_names"),
        (lambda m: m["features"].update(smell=1), "another feature spec"),
        (lambda m: m.update(features=[1]), "another feature spec"),
        (lambda m: m.pop("features"), "another feature spec"),
        (lambda m: m.pop("controller_id"), "controller_id is missing"),
        (lambda m: m.update(controller_id=7), "controller_id=7: expected text"),
        (lambda m: m.pop("files"), "files is missing"),
        (lambda m: m.update(files=["a"]), r"files=\[a\]: expected \{NAME: text, ...\}"),
        (lambda m: m["files"].pop(WEIGHTS), f"{WEIGHTS}.*SHA-256"),
        (lambda m: m.pop("egovcp_version"), "egovcp_version is missing"),
        (lambda m: m.update(datasets=[{"revision": "a"}]), r"datasets\[0\].repo_id is missing"),
        (lambda m: m.update(train_config={"datasets": "a"}), "train_config.datasets=a: expected"),
        (lambda m: m.update(train_config={"dataset": {"root": 5}}), "root of a dataset .*=5"),
    ],
)
def test_a_manifest_of_something_else_is_refused(
    folder: Path, change: Callable[[Json], object], message: str
) -> None:
    edit(folder / MANIFEST, change)
    with pytest.raises(ArtifactError, match=message):
        load_artifact(str(folder))


@pytest.mark.parametrize("content", ["[]", "3", "null", "not json", '{"a": ', "\xff\xfe"])
def test_a_damaged_manifest_is_refused(folder: Path, content: str) -> None:
    (folder / MANIFEST).write_text(content, encoding="latin-1")
    with pytest.raises(ArtifactError, match=MANIFEST):
        load_artifact(str(folder))


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.pop("world_model"),
        lambda c: c.pop("planner"),
        lambda c: c["world_model"].update(hidden=48),
        lambda c: c["world_model"].update(hidden="wide"),
        lambda c: c["world_model"].update(channels=[4, 8]),
        lambda c: c["world_model"].update(surprise=1),
        lambda c: c.update(world_model=[1, 2]),
        lambda c: c["planner"].update(samples=0),
        lambda c: c["planner"].update(termination_rule="never"),
        lambda c: c.update(planner=None),
    ],
)
def test_an_invalid_configuration_is_refused(
    folder: Path, change: Callable[[Json], object]
) -> None:
    """Even where somebody has signed it again."""
    edit(folder / CONFIG, change)
    sign(folder)
    with pytest.raises(ArtifactError, match="copy"):
        load_artifact(str(folder))


def test_options_are_read_without_weights(folder: Path) -> None:
    (folder / WEIGHTS).unlink()
    assert read_options(folder) == (PRESETS["debug"], PLANNER)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.pop("planner"),
        lambda c: c["world_model"].update(surprise=1),
        lambda c: c["planner"].update(samples=0),
        lambda c: c.update(planner=None),
    ],
)
def test_options_of_another_version_are_refused(
    folder: Path, change: Callable[[Json], object]
) -> None:
    edit(folder / CONFIG, change)
    with pytest.raises(ArtifactError, match=CONFIG):
        read_options(folder)


@pytest.mark.parametrize("option", ["hands_cost", "step_cost"])
def test_planner_options_of_another_version_are_refused_with_the_remedy(
    folder: Path, option: str
) -> None:
    edit(folder / CONFIG, lambda c: c["planner"].update({option: 0.05}))
    with pytest.raises(ArtifactError, match=f"unknown option planner.{option}.* trained again"):
        read_options(folder)


class _Bomb:
    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return (pytest.fail, ("a pickle was executed",))


def test_a_pickle_is_never_executed(folder: Path) -> None:
    (folder / WEIGHTS).write_bytes(pickle.dumps(_Bomb()))
    sign(folder)
    with pytest.raises(ArtifactError, match="weights"):
        load_artifact(str(folder))
    torch.save(_Bomb(), folder / WEIGHTS)
    sign(folder)
    with pytest.raises(ArtifactError, match="weights"):
        load_artifact(str(folder))


def test_loading_never_unpickles(original: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        pytest.fail("unpickling")

    for target in ("pickle.load", "pickle.loads", "pickle.Unpickler", "torch.load"):
        monkeypatch.setattr(target, refuse)
    load_artifact(str(original))


def test_it_holds_only_json_and_safetensors(original: Path) -> None:
    assert {path.name for path in original.iterdir()} == FILES


def test_another_controller_is_refused(original: Path) -> None:
    loaded = load_artifact(str(original))
    loaded.require_controller("stance-1")
    with pytest.raises(ArtifactError, match=r"policy.*'stance-1'.*'walker-2'"):
        loaded.require_controller("walker-2")
