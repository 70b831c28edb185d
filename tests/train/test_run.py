"""egovcp-train from its command line: what it writes, what it refuses."""

import dataclasses
import os
import pwd
import re
import shutil
from pathlib import Path

import draccus
import numpy as np
import pytest
import torch

from egovcp import spec
from egovcp.artifact import load_artifact
from egovcp.checks import check_artifact
from egovcp.cli import parse_config
from egovcp.data import DatasetWriter, Episode, Provenance
from egovcp.entry_point import prepare_process
from egovcp.errors import UsageError
from egovcp.manifest import MANIFEST
from egovcp.model import PRESETS as MODELS
from egovcp.model import Batch, world_model_loss
from egovcp.testing import random_batch, toy_model
from egovcp_train.checkpoint import load_training_state
from egovcp_train.config import ABLATIONS, PRESETS, TrainConfig
from egovcp_train.device import choose_bf16
from egovcp_train.loop import Learner
from egovcp_train.train import main, option_defaults
from tests.support.arguments import Arguments
from tests.support.earlier import without_optional_columns


def _files(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def _last(output: Path) -> Path:
    return output / "checkpoints" / "last"


# --- a run ------------------------------------------------------------------------------
def test_a_run_writes_checkpoints_and_an_artifact_that_plans(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "run"
    assert main(arguments(output, sampling__length=16)) == 0
    assert sorted(p.name for p in (output / "checkpoints").iterdir()) == [
        "000003",
        "000006",
        "last",
    ]
    assert _last(output).resolve().name == "000006"
    artifact = check_artifact(str(_last(output) / "pretrained_model"))
    assert artifact.controller_id == "stance-test"
    assert artifact.planner.samples == 16
    assert artifact.manifest["step"] == 6
    assert {"latent/active", "latent/kl"} <= artifact.manifest["heldout"].keys()
    assert artifact.manifest["heldout_tasks"]["ball"]["episodes"] == 1
    earlier = load_artifact(str(output / "checkpoints" / "000003" / "pretrained_model"))
    assert earlier.manifest["heldout"] == {}, "it was not evaluated"
    printed = capsys.readouterr().out
    assert "done at step 6" in printed
    assert str(output / "checkpoints" / "000006" / "pretrained_model") in printed


def test_a_gpu_that_cannot_record_steps_is_said_once(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Learner, "capture_error", "operation not permitted")
    assert main(arguments(tmp_path / "run", log_freq=1)) == 0
    said = re.findall("could not be captured as a CUDA graph .*", capsys.readouterr().out)
    assert len(said) == 1
    assert "operation not permitted" in said[0]


def test_the_options_of_a_run_are_kept_and_repeat_it(arguments: Arguments, tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    assert main(arguments(one)) == 0
    saved = one / "train_config.yaml"
    with saved.open(encoding="utf-8") as file:
        config = draccus.load(TrainConfig, file)
    assert (config.steps, config.policy.hidden, config.planner.samples) == (6, 32, 16)
    assert main([f"--config_path={saved}", f"--output_dir={two}"]) == 0
    weights = "pretrained_model/model.safetensors"
    assert (_last(one) / weights).read_bytes() == (_last(two) / weights).read_bytes()


def test_a_user_without_account_and_home_trains(
    arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As under ``docker run --user 12345``."""

    def unknown(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.delenv("HOME", raising=False)
    for name in ("USER", "LOGNAME", "USERNAME", "LNAME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    prepare_process()
    assert main(arguments(tmp_path / "run", steps=1)) == 0


def test_another_seed_gives_other_weights(arguments: Arguments, tmp_path: Path) -> None:
    weights = []
    for seed in (0, 1):
        assert main(arguments(tmp_path / str(seed), seed=seed, steps=2)) == 0
        path = _last(tmp_path / str(seed)) / "pretrained_model" / "model.safetensors"
        weights.append(path.read_bytes())
    assert weights[0] != weights[1]


def test_the_statistics_are_those_of_the_training_episodes(
    arguments: Arguments, tmp_path: Path
) -> None:
    assert main(arguments(tmp_path / "run", steps=1)) == 0
    model = load_artifact(str(_last(tmp_path / "run") / "pretrained_model")).world_model
    assert model.state_mean.abs().max() < 0.5
    assert ((model.state_std - 1).abs() < 0.5).all()
    ceiling = sum(spec.GAMMA**i for i in range(5))
    assert 0 <= model.min_return <= model.return_mean <= ceiling


def test_a_preset_is_where_the_policy_options_start(arguments: Arguments, tmp_path: Path) -> None:
    assert main(arguments(tmp_path / "run", "--policy.latent=5", "--policy.loss.reward=2.5")) == 0
    config = load_artifact(str(_last(tmp_path / "run") / "pretrained_model")).world_model.config
    assert (config.hidden, config.latent, config.loss.reward) == (32, 5, 2.5)


def test_a_run_under_a_clock_ends_early_and_whole(arguments: Arguments, tmp_path: Path) -> None:
    output = tmp_path / "run"
    assert main(arguments(output, steps=10**6, save_freq=10**6, max_minutes=0.05)) == 0
    step = load_artifact(str(_last(output) / "pretrained_model")).manifest["step"]
    assert 0 < step < 10**6


def test_an_empty_folder_is_a_fine_place(arguments: Arguments, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    assert main(arguments(tmp_path / "run", steps=1)) == 0


# --- refusals ---------------------------------------------------------------------------
def _refused(argv: list[str], code: int, capsys: pytest.CaptureFixture[str], message: str) -> None:
    assert main(argv) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    line = printed.err.rpartition("\r")[2]  # a slow computer shows a progress bar first
    assert line.startswith("egovcp-train: error: ")
    assert message in line
    assert line.count("\n") == 1


def test_an_output_folder_that_exists_is_left_alone(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "run"
    output.mkdir()
    (output / "notes.txt").write_text("mine")
    _refused(arguments(output), 2, capsys, "exists and is not empty")
    assert _files(output) == {"notes.txt": b"mine"}


def test_an_output_that_is_a_file_is_left_alone(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "run"
    output.write_text("mine")
    _refused(arguments(output), 2, capsys, "exists")
    assert output.read_text() == "mine"


def test_a_missing_dataset_is_named_before_anything_is_written(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = arguments(tmp_path / "run", dataset__root=tmp_path / "nothing")
    _refused(argv, 3, capsys, f"no such folder: {tmp_path}/nothing")
    assert not (tmp_path / "run").exists()


def test_no_dataset_at_all_is_a_question_of_usage(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _refused(arguments(tmp_path / "run", dataset__root=None), 2, capsys, "no dataset is named")


def test_a_damaged_dataset_is_named(
    arguments: Arguments, dataset_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = Path(shutil.copytree(dataset_root, tmp_path / "broken"))
    (data,) = (broken / "data").rglob("*.parquet")
    data.write_bytes(data.read_bytes()[:1000])
    _refused(arguments(tmp_path / "run", dataset__root=broken), 3, capsys, "broken")
    assert not (tmp_path / "run").exists()


def test_episodes_shorter_than_the_return_are_refused(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _refused(arguments(tmp_path / "run", returns__steps=50), 3, capsys, "--returns.steps")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("parent", ["file", "locked"])
def test_a_place_that_cannot_be_written_is_a_matter_of_the_surroundings(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    parent: str,
) -> None:
    place = tmp_path / parent
    if parent == "file":
        place.write_text("mine")
    else:
        place.mkdir(mode=0o500)
        if os.access(place, os.W_OK):
            pytest.skip("the superuser may write anywhere")
    _refused(arguments(place / "run"), 5, capsys, f"cannot write to {place}")


def test_several_processes_are_refused(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")  # as set by torchrun and accelerate launch
    _refused(arguments(tmp_path / "run"), 2, capsys, "WORLD_SIZE=2 in the environment")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"steps": 0}, "--steps"),
        ({"batch_size": 0}, "--batch_size"),
        ({"save_freq": 0}, "--save_freq"),
        ({"device": "abacus"}, "--device"),
        ({"mixed_precision": "fp8"}, "--mixed_precision=fp8: expected no or bf16 or auto"),
        ({"preset": "huge"}, "unknown --preset=huge"),
        ({"planner__elites": 99}, "elites"),
        ({"sampling__length": 0}, "length"),
        ({"stpes": 3}, "did you mean '--steps'"),
        ({"config_path": "absent.yaml"}, "--preset=debug and --config_path=absent.yaml"),
    ],
)
def test_senseless_options_are_refused_before_anything_is_written(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flags: dict[str, object],
    message: str,
) -> None:
    _refused(arguments(tmp_path / "run", **flags), 2, capsys, message)
    assert not (tmp_path / "run").exists()


def test_a_loss_that_is_not_a_number_ends_the_run_at_once(
    tmp_path: Path, arguments: Arguments, capsys: pytest.CaptureFixture[str]
) -> None:
    explosive = {"lr": 1e12, "warmup_steps": 0, "grad_clip": 1e30}
    options = {f"optimizer__{name}": value for name, value in explosive.items()}
    assert main(arguments(tmp_path / "run", steps=100, save_freq=100, **options)) == 3
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert last_line.startswith(
        "egovcp-train: error: loss or gradient was not finite in 3 consecutive steps"
    )
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.parametrize("sick", ["privileged", "state"])
def test_a_fault_in_mid_run_stops_within_3_steps_and_keeps_the_last_good_checkpoint(
    tmp_path: Path,
    arguments: Arguments,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    sick: str,
) -> None:
    """From the fifth step on the loss is not finite; step 6 would be saved, were it good."""
    update, steps = Learner.update, []

    def faulty(self: Learner, batch: Batch, progress: float) -> dict[str, torch.Tensor]:
        steps.append(self.step + 1)
        if self.step >= 4:
            field = getattr(batch, sick).float()
            batch = batch._replace(**{sick: torch.full_like(field, torch.nan)})
        return update(self, batch, progress)

    monkeypatch.setattr(Learner, "update", faulty)
    output = tmp_path / "run"
    assert main(arguments(output, steps=100, save_freq=2)) == 3
    assert steps[-1] == 7
    assert "last good checkpoint" in capsys.readouterr().err.splitlines()[-1]
    for folder in (output / "checkpoints").iterdir():
        weights = load_artifact(str(folder / "pretrained_model")).world_model.state_dict()
        assert all(x.isfinite().all() for x in weights.values())
    learner = load_training_state(output)["learner"]
    kept = [*learner["model"].values(), *learner["averaged"].values()]
    assert all(x.isfinite().all() for x in kept)

    monkeypatch.undo()
    assert main([f"--output_dir={output}", "--resume", "--steps=9"]) == 0


def test_weights_that_a_finite_step_has_made_infinite_are_not_saved(
    tmp_path: Path, arguments: Arguments, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "run"
    explosive = {"optimizer__lr": 1e38, "optimizer__warmup_steps": 0, "save_freq": 1}
    assert main(arguments(output, **explosive)) == 3
    assert "not finite" in capsys.readouterr().err.splitlines()[-1]
    assert not list(output.glob("checkpoints/*"))


def test_bfloat16_learns_about_the_same(arguments: Arguments, tmp_path: Path) -> None:
    for precision in ("no", "bf16"):
        assert main(arguments(tmp_path / precision, mixed_precision=precision, steps=3)) == 0
    exact, rough = (load_training_state(tmp_path / p)["learner"] for p in ("no", "bf16"))
    assert all(x.dtype == torch.float32 for x in rough["model"].values())
    pairs = [(exact["model"][k], rough["model"][k]) for k in exact["model"]]
    assert any(not torch.equal(a, b) for a, b in pairs)
    assert all((a - b).abs().max() < 0.02 for a, b in pairs)


@pytest.mark.parametrize("native", [True, False])
def test_bfloat16_is_chosen_where_the_device_computes_in_it(
    native: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": native})
    assert choose_bf16("auto", torch.device("cpu")) == native
    assert not choose_bf16("no", torch.device("cpu"))


def test_the_controller_of_the_data_goes_into_the_artifact(
    arguments: Arguments, tmp_path: Path
) -> None:
    rows = 12
    last = np.arange(rows) == rows - 1
    with DatasetWriter(tmp_path / "other", Provenance("walker-7")) as writer:
        for number in range(2):
            writer.add(
                Episode(
                    depth=np.zeros((rows, spec.DEPTH_ROWS, spec.DEPTH_COLS), dtype=np.uint16),
                    state=np.zeros((rows, spec.STATE_DIM), dtype=np.float32),
                    action=np.zeros((rows, spec.ACTION_DIM), dtype=np.float32),
                    reward=np.zeros(rows, dtype=np.float32),
                    done=last,
                    success=np.zeros(rows, dtype=np.bool_),
                    truncated=last,
                    task="wall",
                    time_limit=rows,
                    metadata={"seed": 0, "episode": number},
                )
            )
    argv = arguments(tmp_path / "run", dataset__root=tmp_path / "other", steps=2)
    assert main(argv) == 0
    folder = _last(tmp_path / "run") / "pretrained_model"
    assert (folder / MANIFEST).is_file()
    assert load_artifact(str(folder)).controller_id == "walker-7"


@pytest.mark.parametrize("mirror", [True, False])
def test_only_a_model_of_mirrored_windows_plans_in_a_mirror(mirror: bool) -> None:
    assert _parsed(f"--sampling.mirror={mirror}").planner.mirror == mirror


def test_paper_preset_sets_the_options_of_the_paper_outside_the_world_model_too() -> None:
    """A single flag still overrides it."""
    config = _parsed("--preset=paper", "--planner.samples=64", "--optimizer.lr=0.01")
    assert config.policy.world_model() == MODELS["paper"]
    assert not config.sampling.mirror
    assert config.returns.keep_truncated
    assert config.planner.termination_rule == "paper"
    assert (config.planner.samples, config.planner.elites) == (64, 64)
    assert (config.optimizer.lr, config.optimizer.ema) == (0.01, 0.0)
    assert config.policy.loss.q_target == "mc"


def test_a_cost_of_actions_is_not_charged_by_q_and_by_the_planner() -> None:
    weights = "--returns.weights={pose: 1.0}"
    with pytest.raises(UsageError, match=r"returns.weights puts pose into Q.*planner.pose_cost"):
        _parsed(weights)
    assert _parsed(weights, "--planner.pose_cost=0").returns.weights == {"pose": 1.0}


def test_weights_need_recorded_terms(
    dataset_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = Path(shutil.copytree(dataset_root, tmp_path / "old"))
    without_optional_columns(old)
    flags = [f"--dataset.root={old}", f"--output_dir={tmp_path / 'run'}", "--preset=debug"]
    assert main([*flags, "--reward.weights={block: 2.0}"]) == 2
    assert "does not have the reward terms" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", PRESETS)
def test_preset_is_the_configuration_that_its_function_returns(name: str) -> None:
    assert _parsed(f"--preset={name}") == dataclasses.replace(PRESETS[name](), output_dir="x")


def test_ablations_differ_from_the_default_in_losses_alone() -> None:
    default = _parsed()
    for name in ABLATIONS:
        config = _parsed(f"--preset={name}")
        assert config.policy.loss != default.policy.loss
        own = {"loss": default.policy.loss, "value_loss": default.policy.value_loss}
        policy = dataclasses.replace(config.policy, **own)
        assert dataclasses.replace(config, preset="default", policy=policy) == default


def test_command_has_at_most_70_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help=all"])
    assert len(re.findall(r"^ +--", capsys.readouterr().out, re.MULTILINE)) <= 70


def test_a_file_may_name_a_preset_and_change_it(tmp_path: Path) -> None:
    file = tmp_path / "changed.yaml"
    file.write_text("preset: paper\nsteps: 100\nplanner: {elites: 8}\n", encoding="utf-8")
    config = _parsed(f"--config_path={file}", "--batch_size=2")
    assert (config.preset, config.steps, config.batch_size) == ("paper", 100, 2)
    assert (config.planner.samples, config.planner.elites) == (1024, 8)
    assert config.policy.loss.q_target == "mc"


def _parsed(*flags: str) -> TrainConfig:
    return parse_config(
        TrainConfig, ["--output_dir=x", *flags], "egovcp-train", "", option_defaults
    )


# --- start from a policy ----------------------------------------------------------------------
def test_a_run_starts_from_the_weights_and_the_normalisation_of_a_policy(
    tmp_path: Path, arguments: Arguments
) -> None:
    assert main(arguments(tmp_path / "first")) == 0
    first = _last(tmp_path / "first") / "pretrained_model"
    options = {"policy__pretrained_path": first, "steps": 1, "seed": 3}
    assert main(arguments(tmp_path / "second", **options, optimizer__lr=1e-12)) == 0
    before = load_artifact(str(first)).world_model.state_dict()
    after = load_artifact(str(_last(tmp_path / "second") / "pretrained_model"))
    for name, value in after.world_model.state_dict().items():
        torch.testing.assert_close(value, before[name], msg=name)


@pytest.mark.parametrize(
    ("flag", "found"), [("--returns.gamma=0.9", "0.97"), ("--returns.scale=none", "dataset")]
)
def test_a_policy_of_another_return_is_refused(
    flag: str, found: str, tmp_path: Path, arguments: Arguments, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(tmp_path / "first", steps=1)) == 0
    first = _last(tmp_path / "first") / "pretrained_model"
    assert main(arguments(tmp_path / "second", flag, policy__pretrained_path=first)) == 2
    message = capsys.readouterr().err
    assert f"{flag}, but the Q of --policy.pretrained_path={first} was trained with" in message
    assert f"give {flag.partition('=')[0]}={found}" in message


def test_without_multistep_losses_no_state_is_imagined_ahead() -> None:
    loss = PRESETS["no_multistep"]().policy.loss
    model = toy_model(dataclasses.replace(MODELS["debug"], loss=loss))
    _, terms = world_model_loss(model, random_batch(2, 14))
    assert not [name for name in terms if "multistep" in name]


def test_a_policy_of_other_networks_is_refused(
    tmp_path: Path, arguments: Arguments, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = arguments(tmp_path / "run", policy__pretrained_path="contact")
    assert main(argv) == 2
    expected = "--policy.pretrained_path=contact: its networks are not those of --policy"
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
