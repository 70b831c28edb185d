"""Conformance checks of a world model and of a policy artifact."""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import Tensor

from egovcp.artifact import Artifact, load_artifact
from egovcp.errors import ArtifactError, ConformanceError
from egovcp.model import Carry, WorldModel
from egovcp.robot_spec import RobotSpec

TOLERANCE = 1e-4  # rounding of network outputs


class RandomInputs:
    """Random inputs of a robot for B rows, given by the seed."""

    def __init__(self, rows: int, seed: int, robot: RobotSpec) -> None:
        rng = torch.Generator().manual_seed(seed)
        self.action = torch.rand(rows, robot.action_dim, generator=rng) * 2 - 1
        pixels, farthest = (rows, *robot.depth), round(1000 * robot.depth_max_m)
        self.depth = torch.randint(0, farthest, pixels, generator=rng, dtype=torch.int32)
        self.state = torch.randn(rows, robot.state_dim, generator=rng)
        self.plans = torch.rand(rows, 3, robot.action_dim, generator=rng) * 2 - 1


@torch.no_grad()
def check_world_model(model: WorldModel) -> None:
    """Check the contract that filtering on the robot and planning rely on.

    Raises:
        ConformanceError: names the method and the property.
    """
    rows = 3
    first, rest = torch.ones(rows, dtype=torch.bool), torch.zeros(rows, dtype=torch.bool)
    one, two = (RandomInputs(rows, seed, model.robot) for seed in range(2))
    start = model.observe(model.initial(rows), one.action, one.depth, one.state, first)
    before = copy.deepcopy(start)
    later = model.observe(start, two.action, two.depth, two.state, rest)
    _same("observe changes its input carry", before, start)
    _require(
        later.h.shape == start.h.shape and later.z.shape == start.z.shape,
        "observe changes the shape of the carry",
    )
    _finite("observe", later)
    again = model.observe(start, two.action, two.depth, two.state, rest)
    _same("observe gives another result the second time", later, again)
    lost = later.map(lambda x: torch.full_like(x, torch.nan))
    for name, memory in (("the memory", later), ("a memory of NaN", lost)):
        fresh = model.observe(memory, two.action, one.depth, one.state, first)
        _same(f"observe with is_first does not forget {name} and the last action", start, fresh)
    _check_rows(model, start, two, later)
    _check_planning(model, later, two.plans)
    _check_decoder(model, later)


def _check_rows(model: WorldModel, start: Carry, inputs: RandomInputs, batched: Carry) -> None:
    """Each row of a batch gives the same result alone."""
    continues = torch.zeros(1, dtype=torch.bool)
    for b in range(len(inputs.action)):
        row = slice(b, b + 1)
        observed = inputs.action[row], inputs.depth[row], inputs.state[row], continues
        alone = model.observe(_row(start, row), *observed)
        problem = "observe lets the rows of a batch influence each other"
        _same(problem, _row(batched, row), alone)


def _row(carry: Carry, row: slice) -> Carry:
    return carry.map(lambda x: x[row])


def _check_planning(model: WorldModel, carry: Carry, plans: Tensor) -> None:
    """imagine, value and termination broadcast (E, 1, ...) states over (E, M, 7) actions."""
    shared = model.expand_candidates(carry)
    before = copy.deepcopy(shared)
    ahead = model.imagine(shared, plans)
    _same("imagine changes its input carry", before, shared)
    _finite("imagine", ahead)
    termination = model.termination(ahead)
    heads = {
        "value": model.value(shared, plans),
        "value of imagined states": model.value(ahead, plans),
        "termination of imagined states": termination,
    }
    for name, answer in heads.items():
        found, expected = tuple(answer.shape), tuple(plans.shape[:2])
        _require(found == expected, f"{name} has shape {found}, expected {expected}")
        _require(answer.isfinite().all(), f"{name} is not finite")
    is_probability = ((termination >= 0) & (termination <= 1)).all()
    _require(is_probability, "termination is not a probability")
    _require(torch.as_tensor(model.min_return).isfinite().all(), "min_return is not finite")
    alone, first = model.imagine(carry, plans[:, 0]), ahead.map(lambda x: x[:, 0])
    _same("imagine lets the candidates influence each other", first, alone)


def _check_decoder(model: WorldModel, carry: Carry) -> None:
    depth, state = model.decode(carry)
    found, rows = (tuple(depth.shape), tuple(state.shape)), len(carry.h)
    expected = (rows, *model.robot.depth), (rows, model.robot.state_dim)
    _require(found == expected, f"decode gives {found[0]} and {found[1]}")
    _require(depth.isfinite().all() and state.isfinite().all(), "decode is not finite")
    _require((depth >= 0).all(), "decode gives negative depth")


def _require(ok: bool | Tensor, problem: str) -> None:
    if not ok:
        raise ConformanceError(f"world model: {problem}")


def _finite(name: str, carry: Carry) -> None:
    _require(all(part.isfinite().all() for part in carry), f"{name} is not finite")


def _same(problem: str, expected: Carry, found: Carry) -> None:
    for a, b in zip(expected, found, strict=True):
        close = torch.allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE)
        _require(close, f"{problem}: differs by up to {float((a - b).abs().max()):.3g}")


def check_artifact(path: str, revision: str = "") -> Artifact:
    """Load an artifact, check its model, and let it plan once; raises `ArtifactError`."""
    artifact = load_artifact(path, revision)
    inputs = RandomInputs(1, 0, artifact.robot)
    try:
        check_world_model(artifact.world_model)
    except ConformanceError as error:
        raise ArtifactError(f"{artifact.path}: {error}; train again") from error
    depth, state = inputs.depth.numpy().astype(np.uint16), inputs.state.numpy()
    steps = [artifact.make_policy(seed=0).act(depth, state) for _ in range(2)]
    plan = steps[0].plan
    if not (np.isfinite(plan).all() and np.abs(plan).max() <= 1 and np.isfinite(steps[0].value)):
        raise ArtifactError(f"{artifact.path}: its plan is not finite or leaves [-1, 1]")
    if not np.array_equal(plan, steps[1].plan):
        raise ArtifactError(f"{artifact.path}: a seed does not repeat a plan")
    return artifact
