"""The artefact: what is written is what is loaded, and anything else is refused by name."""

import dataclasses
import hashlib
import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from egovcp import artefact as module
from egovcp import spec
from egovcp.artefact import CONFIG, MANIFEST, WEIGHTS, load_artefact, save_artefact, sealed
from egovcp.errors import ArtefactError, EnvironmentFailure, UsageError
from egovcp.hub import Content, Patience, Publication, publish
from egovcp.model import PRESETS, WorldModel
from egovcp.plan import PlannerConfig, Policy
from egovcp.processors import PROCESSORS
from egovcp.testing import toy_model
from egovcp.testing.hub import FakeHub
from egovcp.testing.hub.faults import Trouble

PLANNER = PlannerConfig(samples=32, elites=4, iterations=1, termination_rule="survival")
QUICK = Patience(attempts=2, wait_s=0.01, timeout_s=20)
PROVENANCE = {"controller_id": "stance-1", "datasets": [{"repo_id": "me/ball"}]}

FILES = {CONFIG, WEIGHTS, MANIFEST, *PROCESSORS}

type Json = dict[str, Any]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artefact that tests must not change."""
    path = tmp_path_factory.mktemp("artefact") / "policy"
    model = toy_model()
    model.state_mean.uniform_(-1, 1)
    model.return_floor.fill_(-7.0)
    save_artefact(path, model, PLANNER, PROVENANCE)
    return path


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy to tamper with."""
    return Path(shutil.copytree(original, tmp_path / "copy"))


def _edit(path: Path, change: Callable[[Json], object]) -> None:
    """A manifest is sealed again: what is wrong with its content is found all the same."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(sealed(content) if path.name == MANIFEST else content))


def _sign(folder: Path) -> None:
    """Make the manifest agree with whatever the files now hold."""
    hashes = {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in (CONFIG, WEIGHTS)
    }
    _edit(folder / MANIFEST, lambda m: m["files"].update(hashes))


# --- round trip ------------------------------------------------------------------------
def test_the_loaded_policy_acts_as_the_saved_one(original: Path) -> None:
    saved = toy_model()
    loaded = load_artefact(str(original))
    saved.load_state_dict(loaded.world_model.state_dict())
    rng = np.random.default_rng(0)
    depth = rng.integers(0, 5000, (2, spec.DEPTH_ROWS, spec.DEPTH_COLS)).astype(np.uint16)
    state = rng.normal(size=(2, spec.STATE_DIM)).astype(np.float32)
    mine = Policy(saved, PLANNER, num_envs=2, seed=4)
    theirs = loaded.make_policy(num_envs=2, seed=4)
    for _ in range(3):
        a, b = (policy.act(depth, state) for policy in (mine, theirs))
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
        mine.advance(a.action)
        theirs.advance(b.action)
        np.testing.assert_array_equal(mine.reconstruct(), theirs.reconstruct())


def test_weights_statistics_and_settings_survive(tmp_path: Path) -> None:
    model = toy_model()
    model.state_std.uniform_(0.5, 2)
    model.return_floor.fill_(-7.0)
    save_artefact(tmp_path / "policy", model, PLANNER, PROVENANCE)
    loaded = load_artefact(str(tmp_path / "policy"))
    kept = loaded.world_model.state_dict()
    assert kept.keys() == model.state_dict().keys()
    for name, value in model.state_dict().items():
        assert torch.equal(kept[name], value), name
    assert loaded.world_model.config == model.config
    assert loaded.planner == PLANNER
    assert loaded.manifest["datasets"] == PROVENANCE["datasets"]
    assert not loaded.world_model.training


def test_saving_what_was_loaded_is_the_identity(original: Path, tmp_path: Path) -> None:
    loaded = load_artefact(str(original))
    save_artefact(tmp_path / "again", loaded.world_model, loaded.planner, PROVENANCE)
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (original / name).read_bytes()


def test_another_planner_can_be_asked_for(original: Path) -> None:
    other = PlannerConfig(samples=8, elites=2, horizon=2)
    assert load_artefact(str(original)).make_policy(planner=other).config == other


def test_an_artefact_without_the_younger_options_loads_as_what_it_was(folder: Path) -> None:
    """They are absent in files of an earlier version; their defaults change nothing."""
    shutil.rmtree(folder)
    model = WorldModel(dataclasses.replace(PRESETS["debug"], q_heads=1))
    save_artefact(folder, model, PlannerConfig(), {"controller_id": "s-1"})
    expected = load_artefact(str(folder))

    def forget(config: Json) -> None:
        for name in ("value_loss", "q_heads", "value_units"):
            del config["world_model"][name]
        for name in ("near", "near_threshold", "free_nats_per", "reward"):
            del config["world_model"]["loss"][name]
        for name in ("latent", "ensemble"):
            del config["planner"][name]

    _edit(folder / CONFIG, forget)
    _sign(folder)
    found = load_artefact(str(folder))
    assert (found.world_model.config, found.planner) == (
        expected.world_model.config,
        expected.planner,
    )


def test_a_model_from_before_flights_were_followed_does_not_follow_them(folder: Path) -> None:
    assert load_artefact(str(folder)).world_model.config.follows_flight
    _edit(folder / CONFIG, lambda config: config["world_model"].pop("flight"))
    _sign(folder)
    assert not load_artefact(str(folder)).world_model.config.follows_flight


def test_options_that_the_weights_contradict_are_refused(folder: Path) -> None:
    _edit(folder / CONFIG, lambda config: config["world_model"].update(q_heads=3))
    _sign(folder)
    with pytest.raises(
        ArtefactError, match=r"weights and configuration disagree.*more_value_heads"
    ):
        load_artefact(str(folder))


# --- refusals --------------------------------------------------------------------------
@pytest.mark.parametrize("name", sorted(FILES))
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ArtefactError, match=name):
        load_artefact(str(folder))


@pytest.mark.parametrize("name", sorted(FILES - {MANIFEST}))
@pytest.mark.parametrize("where", [0, -1])
def test_a_changed_byte_is_noticed(folder: Path, name: str, where: int) -> None:
    content = bytearray((folder / name).read_bytes())
    content[where] ^= 1
    (folder / name).write_bytes(content)
    with pytest.raises(ArtefactError, match=f"{name}.*SHA-256"):
        load_artefact(str(folder))


@pytest.mark.parametrize("word", ["stance-1", "sha256", "schema_version", "files"])
def test_no_word_of_the_manifest_changes_unnoticed(folder: Path, word: str) -> None:
    text = (folder / MANIFEST).read_text()
    assert word in text
    (folder / MANIFEST).write_text(text.replace(word, word.upper(), 1))
    with pytest.raises(ArtefactError, match=MANIFEST):
        load_artefact(str(folder))


def test_an_older_artefact_without_files_for_lerobot_still_loads(folder: Path) -> None:
    for name in PROCESSORS:
        (folder / name).unlink()
    _edit(folder / MANIFEST, lambda m: [m["files"].pop(name) for name in PROCESSORS])
    assert load_artefact(str(folder)).planner == PLANNER


@pytest.mark.parametrize("name", sorted(FILES))
def test_a_truncated_file_is_noticed(folder: Path, name: str) -> None:
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(ArtefactError, match=name):
        load_artefact(str(folder))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(schema_version=1), "schema version 1"),
        (lambda m: m.pop("schema_version"), "schema version None"),
        (lambda m: m["features"].update(planner_hz=50), "another feature spec.*planner_hz"),
        (lambda m: m["features"]["action_box"].update(low=[0] * 7), "feature spec.*action_box"),
        (lambda m: m["features"]["state_names"].pop(), "feature spec.*state_names"),
        (lambda m: m["features"].update(smell=1), "another feature spec"),
        (lambda m: m.update(features=[1]), "another feature spec"),
        (lambda m: m.pop("features"), "another feature spec"),
        (lambda m: m.pop("controller_id"), "no controller_id"),
        (lambda m: m.update(controller_id=7), "no controller_id"),
        (lambda m: m.pop("files"), "SHA-256"),
        (lambda m: m.update(files=["a"]), "SHA-256"),
        (lambda m: m["files"].pop(WEIGHTS), f"{WEIGHTS}.*SHA-256"),
    ],
)
def test_a_manifest_of_something_else_is_refused(
    folder: Path, change: Callable[[Json], object], message: str
) -> None:
    _edit(folder / MANIFEST, change)
    with pytest.raises(ArtefactError, match=message):
        load_artefact(str(folder))


@pytest.mark.parametrize("content", ["[]", "3", "null", "not json", '{"a": ', "\xff\xfe"])
def test_a_manifest_that_is_none_is_refused(folder: Path, content: str) -> None:
    (folder / MANIFEST).write_text(content, encoding="latin-1")
    with pytest.raises(ArtefactError, match=MANIFEST):
        load_artefact(str(folder))


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
def test_a_configuration_that_cannot_be_is_refused(
    folder: Path, change: Callable[[Json], object]
) -> None:
    """Even where somebody has signed it again."""
    _edit(folder / CONFIG, change)
    _sign(folder)
    with pytest.raises(ArtefactError, match="copy"):
        load_artefact(str(folder))


class _Bomb:
    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return (pytest.fail, ("a pickle was executed",))


def test_a_pickle_is_never_executed(folder: Path) -> None:
    (folder / WEIGHTS).write_bytes(pickle.dumps(_Bomb()))
    _sign(folder)
    with pytest.raises(ArtefactError, match="weights"):
        load_artefact(str(folder))
    torch.save(_Bomb(), folder / WEIGHTS)
    _sign(folder)
    with pytest.raises(ArtefactError, match="weights"):
        load_artefact(str(folder))


def test_loading_never_unpickles(original: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        pytest.fail("unpickling")

    for target in ("pickle.load", "pickle.loads", "pickle.Unpickler", "torch.load"):
        monkeypatch.setattr(target, refuse)
    load_artefact(str(original))


def _mutate(rng: np.random.Generator, content: bytes) -> bytes:
    """A few bytes changed, cut out, doubled or put in, anywhere."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        at, length = int(rng.integers(len(data) or 1)), int(rng.integers(1, 9))
        match int(rng.integers(5)):
            case 0:
                data[at : at + 1] = bytes([int(rng.integers(256))])
            case 1:
                del data[at : at + length]
            case 2:
                data[at:at] = data[at : at + length]
            case 3:
                data[at:at] = rng.bytes(length)
            case 4:
                del data[at:]
    return bytes(data)


def _near_the_head(rng: np.random.Generator, content: bytes) -> bytes:
    """The same where a file of weights says what follows."""
    return _mutate(rng, content[:600]) + content[600:]


def _loaded(folder: Path) -> dict[str, torch.Tensor] | None:
    try:
        return load_artefact(str(folder)).world_model.state_dict()
    except ArtefactError:
        return None


def test_of_1000_mutated_artefacts_none_loads_as_another_or_runs_code(
    original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        pytest.fail("code of the artefact")

    for target in ("pickle.load", "pickle.loads", "pickle.Unpickler", "torch.load"):
        monkeypatch.setattr(target, refuse)
    folder, rng = Path(shutil.copytree(original, tmp_path / "copy")), np.random.default_rng(0)
    contents = {name: (original / name).read_bytes() for name in sorted(FILES)}
    truth, loads = load_artefact(str(original)).world_model.state_dict(), 0
    for number in range(1000):
        name = sorted(FILES)[number % len(FILES)]
        mutate = _near_the_head if number % 2 else _mutate
        mutated = mutate(rng, contents[name])
        (folder / name).write_bytes(mutated)
        weights = _loaded(folder)
        assert weights is None or mutated == contents[name] or name == MANIFEST
        if weights is not None:
            loads += 1
            assert all(torch.equal(weights[key], value) for key, value in truth.items())
        if name in (CONFIG, WEIGHTS):
            _sign(folder)  # by whoever changed it: what is loaded may differ, what happens may not
            _loaded(folder)
            (folder / MANIFEST).write_bytes(contents[MANIFEST])
        (folder / name).write_bytes(contents[name])
    assert loads < 20


def test_it_holds_only_json_and_safetensors(original: Path) -> None:
    assert {path.name for path in original.iterdir()} == FILES


def test_another_controller_is_refused(original: Path) -> None:
    loaded = load_artefact(str(original))
    loaded.require_controller("stance-1")
    with pytest.raises(ArtefactError, match=r"policy.*'stance-1'.*'walker-2'"):
        loaded.require_controller("walker-2")


# --- where it lies ---------------------------------------------------------------------
@pytest.fixture
def commit(hub: FakeHub, original: Path) -> str:
    """The artefact is on the Hub as model `me/policy`, with a card and a file that is code."""
    contents = {path.name: Content(path) for path in original.iterdir()}
    extra = {"README.md": Content(b"---\nlicense: mit\n---\n"), "modeling.py": Content(b"raise")}
    publication = Publication("me/policy", contents | extra, "a policy", repo_type="model")
    made = publish(publication, QUICK).commit
    hub.heal()
    return made


@pytest.mark.parametrize("path", ["./absent", "/absent/policy", "absent", "a/b/c", "a/b--c", "/"])
def test_a_path_without_artefact_is_refused_without_network(hub: FakeHub, path: str) -> None:
    with pytest.raises(ArtefactError, match=rf"no policy artefact at '{path}'|{MANIFEST}"):
        load_artefact(path)
    assert not hub.requests


def test_a_file_is_no_artefact(original: Path) -> None:
    with pytest.raises(ArtefactError, match="no policy artefact"):
        load_artefact(str(original / WEIGHTS))


def test_a_folder_has_no_revision(original: Path) -> None:
    with pytest.raises(UsageError, match="is a folder, and revision v1"):
        load_artefact(str(original), "v1")


def test_a_card_beside_it_does_no_harm(folder: Path) -> None:
    (folder / "README.md").write_text("# A policy")
    (folder / "assets").mkdir()
    load_artefact(str(folder))


def test_a_hub_id_is_fetched_at_its_revision(hub: FakeHub, original: Path, commit: str) -> None:
    newer = {path.name: Content(path) for path in original.iterdir()}
    manifest = json.loads((original / MANIFEST).read_text()) | {"controller_id": "walker-2"}
    newer[MANIFEST] = Content(json.dumps(sealed(manifest)).encode())
    publish(Publication("me/policy", newer, "another", repo_type="model"), QUICK)
    assert load_artefact("me/policy").controller_id == "walker-2"
    pinned = load_artefact("me/policy", commit)
    assert pinned.controller_id == "stance-1"
    assert pinned.path.name == commit
    hub.heal()
    load_artefact("me/policy", commit)
    assert not hub.requests, "a commit that is here cannot have changed"


def test_only_data_is_fetched(hub: FakeHub, commit: str) -> None:
    found = load_artefact("me/policy", commit).path
    assert {path.name for path in found.iterdir()} == FILES


def test_a_dataset_of_that_name_is_no_policy(hub: FakeHub, original: Path) -> None:
    contents = {path.name: Content(path) for path in original.iterdir()}
    publish(Publication("me/ball", contents, "a dataset"), QUICK)
    with pytest.raises(ArtefactError, match="the Hub has no model me/ball"):
        load_artefact("me/ball")


@pytest.mark.parametrize(
    ("name", "revision", "message"),
    [("me/none", "", "no model me/none"), ("me/policy", "v9", "but not me/policy@v9")],
)
def test_what_the_hub_does_not_have_is_an_artefact_error(
    commit: str, name: str, revision: str, message: str
) -> None:
    with pytest.raises(ArtefactError, match=message):
        load_artefact(name, revision, QUICK)


@pytest.mark.parametrize("trouble", [403, 429, 503, "reset"])
def test_a_failing_hub_is_asked_again_and_then_reported(
    hub: FakeHub, commit: str, trouble: Trouble
) -> None:
    hub.fail("*", trouble, retry_after=0 if trouble == 429 else None)
    with pytest.raises(EnvironmentFailure) as caught:
        load_artefact("me/policy", "", QUICK)
    assert "\n" not in str(caught.value)
    assert sum(hub.requests.values()) == (1 if trouble == 403 else QUICK.attempts)
    hub.heal()
    hub.fail("*", trouble, times=1, retry_after=0 if trouble == 429 else None)
    if trouble != 403:
        assert load_artefact("me/policy", "", QUICK).path.name == commit


def test_without_the_hub_an_earlier_download_serves(
    hub: FakeHub, commit: str, caplog: pytest.LogCaptureFixture
) -> None:
    load_artefact("me/policy", "", QUICK)
    hub.fail("*", 503)
    assert load_artefact("me/policy", "", QUICK).path.name == commit
    assert f"earlier download of commit {commit}" in caplog.text


def test_what_was_tampered_with_on_the_hub_is_refused(hub: FakeHub, original: Path) -> None:
    contents = {path.name: Content(path) for path in original.iterdir()}
    contents[WEIGHTS] = Content(b"x" + (original / WEIGHTS).read_bytes()[1:])
    publish(Publication("me/odd", contents, "tampered", repo_type="model"), QUICK)
    with pytest.raises(ArtefactError, match=f"{WEIGHTS}.*SHA-256"):
        load_artefact("me/odd")


# --- replacing -------------------------------------------------------------------------
def test_an_older_artefact_is_replaced_and_nothing_is_left_over(folder: Path) -> None:
    (folder / "stale").touch()
    save_artefact(folder, toy_model(seed=1), PLANNER, PROVENANCE)
    assert {path.name for path in folder.iterdir()} == FILES
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    loaded = load_artefact(str(folder)).world_model.state_dict()
    expected = toy_model(seed=1).state_dict()
    assert all(torch.equal(loaded[name], expected[name]) for name in expected)


@pytest.mark.parametrize("step", ["save_file", "_write_json", "_sha256"])
def test_a_failure_while_writing_leaves_the_old_artefact(
    folder: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(module, step, fail)
        with pytest.raises(OSError, match="No space left"):
            save_artefact(folder, toy_model(seed=1), PLANNER, PROVENANCE)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    save_artefact(folder, toy_model(seed=1), PLANNER, PROVENANCE)  # leftovers do no harm
    load_artefact(str(folder))


def test_a_failing_rename_leaves_an_artefact(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the last moment, too: never neither the old one nor the new one."""
    rename = Path.rename

    def fail(self: Path, target: Path) -> Path:
        if target == folder and self.name.endswith(".partial"):
            raise OSError(5, "Input/output error")
        return rename(self, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", fail)
        with pytest.raises(OSError, match="Input/output"):
            save_artefact(folder, toy_model(seed=1), PLANNER, PROVENANCE)
    load_artefact(str(folder))


def test_provenance_without_a_controller_is_refused_before_writing(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="controller_id"):
        save_artefact(tmp_path / "policy", toy_model(), PLANNER, {"datasets": []})
    assert not list(tmp_path.iterdir())
