"""What is written is what is loaded, and an old artifact is replaced whole or not at all."""

from pathlib import Path

import numpy as np
import pytest
import torch

from egovcp import artifact as module
from egovcp import spec
from egovcp.artifact import CONFIG, WEIGHTS, load_artifact, save_artifact
from egovcp.errors import ArtifactError
from egovcp.plan import PlannerConfig, Policy
from egovcp.testing import toy_model

from .conftest import FILES, PLANNER, PROVENANCE, Json, edit, sign


def test_the_loaded_policy_acts_as_the_saved_one(original: Path) -> None:
    saved = toy_model()
    loaded = load_artifact(str(original))
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
    model.min_return.fill_(-7.0)
    save_artifact(tmp_path / "policy", model, PLANNER, PROVENANCE)
    loaded = load_artifact(str(tmp_path / "policy"))
    kept = loaded.world_model.state_dict()
    assert kept.keys() == model.state_dict().keys()
    for name, value in model.state_dict().items():
        assert torch.equal(kept[name], value), name
    assert loaded.world_model.config == model.config
    assert loaded.planner == PLANNER
    assert loaded.manifest["datasets"] == PROVENANCE["datasets"]
    assert not loaded.world_model.training


def test_saving_what_was_loaded_is_the_identity(original: Path, tmp_path: Path) -> None:
    loaded = load_artifact(str(original))
    save_artifact(tmp_path / "again", loaded.world_model, loaded.planner, PROVENANCE)
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (original / name).read_bytes()


def test_the_planner_can_be_replaced(original: Path) -> None:
    other = PlannerConfig(samples=8, elites=2, horizon=2)
    assert load_artifact(str(original)).make_policy(planner=other).config == other


def test_absent_options_have_their_defaults(folder: Path) -> None:
    expected = load_artifact(str(folder))

    def remove(config: Json) -> None:
        del config["world_model"]["value_loss"]
        del config["world_model"]["loss"]["free_nats_per"]
        del config["planner"]["latent"]

    edit(folder / CONFIG, remove)
    sign(folder)
    found = load_artifact(str(folder))
    assert found.world_model.config == expected.world_model.config
    assert found.planner == expected.planner


def test_options_that_contradict_the_weights_are_refused(folder: Path) -> None:
    edit(folder / CONFIG, lambda config: config["world_model"]["loss"].update(reward=1.0))
    sign(folder)
    with pytest.raises(ArtifactError, match=rf"{WEIGHTS}.*reward_head\S+ is missing"):
        load_artifact(str(folder))


def test_an_older_artifact_is_replaced_and_nothing_is_left_over(folder: Path) -> None:
    (folder / "stale").touch()
    save_artifact(folder, toy_model(seed=1), PLANNER, PROVENANCE)
    assert {path.name for path in folder.iterdir()} == FILES
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    loaded = load_artifact(str(folder)).world_model.state_dict()
    expected = toy_model(seed=1).state_dict()
    assert all(torch.equal(loaded[name], expected[name]) for name in expected)


@pytest.mark.parametrize("step", ["save", "write_json_file", "write_manifest"])
def test_a_failure_while_writing_leaves_the_old_artifact(
    folder: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(module, step, fail)
        with pytest.raises(OSError, match="No space left"):
            save_artifact(folder, toy_model(seed=1), PLANNER, PROVENANCE)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    save_artifact(folder, toy_model(seed=1), PLANNER, PROVENANCE)  # leftovers do no harm
    load_artifact(str(folder))


def test_a_failing_rename_leaves_an_artifact(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the last moment, too: never neither the old one nor the new one."""
    rename = Path.rename

    def fail(self: Path, target: Path) -> Path:
        if target == folder and self.name == "new":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "rename", fail)
        with pytest.raises(OSError, match="Input/output"):
            save_artifact(folder, toy_model(seed=1), PLANNER, PROVENANCE)
    load_artifact(str(folder))


def test_folders_beside_it_with_similar_names_are_left_alone(folder: Path) -> None:
    others = {folder.with_name(f"{folder.name}{end}") for end in (".old", ".partial")}
    for other in others:
        other.mkdir()
    save_artifact(folder, toy_model(seed=1), PLANNER, PROVENANCE)
    assert set(folder.parent.iterdir()) == {folder, *others}


def test_provenance_without_a_controller_is_refused_before_writing(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="controller_id"):
        save_artifact(tmp_path / "policy", toy_model(), PLANNER, {"datasets": []})
    assert not list(tmp_path.iterdir())
