"""Policies that a seed has damaged are refused within limits, or load exactly what they hold."""

import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load

from egovcp.artifact import WEIGHTS, load_artifact
from egovcp.errors import ArtifactError
from tests.support.limited import run_limited
from tests.support.policy_mutations import ANY_FILE, MARKER, mutate_policy

from .conftest import PLANNER

POLICIES = 44
"""Policies of one part, one of each kind of mutation."""
PARTS = (0, *(pytest.param(part, marks=pytest.mark.slow) for part in range(1, 7)))
_DIFFERENT = 99  # exit code: a policy loaded something else than what its files hold


def _load_and_compare(folder: Path) -> int:
    try:
        loaded = load_artifact(str(folder))
    except ArtifactError as error:
        print(error)
        return error.exit_code
    held = load((folder / WEIGHTS).read_bytes())
    state = loaded.world_model.state_dict()
    same = all(torch.equal(state[name], tensor.float()) for name, tensor in held.items())
    return 0 if same and loaded.planner == PLANNER else _DIFFERENT


@pytest.mark.parametrize("part", PARTS)
def test_mutated_policies_are_refused_within_limits(
    original: Path, tmp_path: Path, part: int
) -> None:
    load_artifact(str(original))  # each child inherits what is initialised on first use
    for seed in range(part * POLICIES, (part + 1) * POLICIES):
        folder = Path(shutil.copytree(original, tmp_path / str(seed)))
        mutation = mutate_policy(folder, seed)
        found = run_limited(lambda folder=folder: _load_and_compare(folder))
        case = f"seed {seed}, {mutation}: {found}"
        assert not found.timed_out, case
        assert not found.has_traceback, case
        assert not (folder / MARKER).exists(), case
        assert "\x1b" not in found.output, case
        assert len(found.output) < 1000, case
        if mutation.culprit is None:
            assert found.exit_code == 0, case
        elif mutation.culprit == ANY_FILE:
            assert found.exit_code in (0, 4), case
        else:
            assert found.exit_code == 4, case
            assert any(name in found.output for name in mutation.culprit.split("|")), case
