"""The networks that the planner calls, as graphs: one tick, a batch of independent rows.

    observe      h, z, action, depth, state, is_first  ->  h_next, z_next
    imagine      h, z, action                          ->  h_next, z_next
    value        h, z, action                          ->  value
    termination  h, z                                  ->  termination
    reward       h, z, action                          ->  reward         if it is predicted

A model that follows flights (`egovcp.model.flight`) has a third part of its memory, `flight`, which
observe, imagine and value read and the first two hand on.

Of several heads of Q, `value` is their mean or the least of them, as the artefact's planner has it.
Normalisation is inside: depth comes in millimetres, proprioception in SI units, and values go out
in units of return. A planner repeats the row of a robot for each of its candidates.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from egovcp import spec
from egovcp.model import Carry, WorldModel, flight
from egovcp.model.camera_pose import camera_pose
from egovcp.model.floor import Floor
from egovcp.plan.choices import Ensemble, judge_of

OPSET: Final = 17

type Tensors = dict[str, Tensor]


class Network(nn.Module):
    """A graph; its inputs and outputs in the order of the names."""

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.model = model


class Following(Network):
    """A graph whose last input, if the model follows flights, is ``flight``."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__(model)
        if model.config.follows_flight:
            self.inputs = (*self.inputs, "flight")


class Advancing(Following):
    """One that hands it on, too."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__(model)
        if model.config.follows_flight:
            self.outputs = (*self.outputs, "flight_next")


class Observe(Advancing):
    """`WorldModel.observe`: depth (B, 48, 64) mm as float32, whole numbers, 0 = not measured."""

    inputs = ("h", "z", "action", "depth", "state", "is_first")
    outputs = ("h_next", "z_next")

    def forward(
        self,
        h: Tensor,
        z: Tensor,
        action: Tensor,
        depth: Tensor,
        state: Tensor,
        is_first: Tensor,
        *flight: Tensor,
    ) -> tuple[Tensor, ...]:
        near = pooled_nearness(depth, self.model.config.depth_max_m)
        carry = Carry(h, z, *flight)
        return _parts(self.model.observe_near(carry, action, near, state, is_first))


class Imagine(Advancing):
    """`WorldModel.imagine`."""

    inputs = ("h", "z", "action")
    outputs = ("h_next", "z_next")

    def forward(self, h: Tensor, z: Tensor, action: Tensor, *flight: Tensor) -> tuple[Tensor, ...]:
        return _parts(self.model.imagine(Carry(h, z, *flight), action))


class Value(Following):
    """`WorldModel.value`, (B,)."""

    inputs = ("h", "z", "action")
    outputs = ("value",)

    def forward(self, h: Tensor, z: Tensor, action: Tensor, *flight: Tensor) -> Tensor:
        return self.model.value(Carry(h, z, *flight), action)


class LeastValue(Value):
    """`WorldModel.lowest_value`, (B,)."""

    def forward(self, h: Tensor, z: Tensor, action: Tensor, *flight: Tensor) -> Tensor:
        return self.model.lowest_value(Carry(h, z, *flight), action)


class Termination(Network):
    """`WorldModel.termination`, (B,)."""

    inputs = ("h", "z")
    outputs = ("termination",)

    def forward(self, h: Tensor, z: Tensor) -> Tensor:
        return self.model.termination(Carry(h, z))


class Reward(Network):
    """`WorldModel.reward`, (B,)."""

    inputs = ("h", "z", "action")
    outputs = ("reward",)

    def forward(self, h: Tensor, z: Tensor, action: Tensor) -> Tensor:
        return self.model.reward(Carry(h, z), action)


def _parts(carry: Carry) -> tuple[Tensor, ...]:
    return tuple(part for part in carry if part is not None)


NETWORKS: Final[Mapping[str, type[Network]]] = {
    "observe": Observe,
    "imagine": Imagine,
    "value": Value,
    "termination": Termination,
}
LEAST: Final[Mapping[str, type[Network]]] = {"value": LeastValue}
REWARD: Final[Mapping[str, type[Network]]] = {"reward": Reward}


def networks_of(model: WorldModel, ensemble: Ensemble) -> Mapping[str, type[Network]]:
    """What there is of this model, by name; `value` is that which the planner asks for."""
    least = LEAST if ensemble == "min" else {}
    return {**NETWORKS, **least, **({} if model.reward_head is None else REWARD)}


def pooled_nearness(depth_mm: Tensor, max_m: float) -> Tensor:
    """`egovcp.model.depth.nearness` in operations that every runtime knows: 3 x 3 pooling."""
    far = float(math.ceil(1e3 * max_m))
    depth = torch.where(depth_mm == 0, far, depth_mm.clamp(0.0, far)).floor()[:, None]
    nearest = -F.max_pool2d(-depth, 3, stride=1, padding=1)
    closed = F.max_pool2d(nearest, 3, stride=1, padding=1)[:, 0]
    return (1.0 - closed * (1e-3 / max_m)).clamp(0.0, 1.0)


def golden_inputs(model: WorldModel, batch: int, seed: int = 0) -> Tensors:
    """Inputs that reach every branch: holes, near and far pixels, and rows that begin."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=generator)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator)

    image = (spec.DEPTH_ROWS, spec.DEPTH_COLS)
    depth = (uniform(*image) * 1.2e3 * model.config.depth_max_m).floor()
    inputs = {
        "h": normal(model.config.hidden).tanh(),
        "z": normal(model.config.latent),
        "action": 2.0 * uniform(spec.ACTION_DIM) - 1.0,
        "depth": depth.masked_fill(uniform(*image) < 0.1, 0.0),
        "state": model.state_mean + 3.0 * model.state_std * normal(spec.STATE_DIM),
        "is_first": torch.arange(batch) % 3 == 0,
    }
    if model.config.follows_flight:
        inputs["flight"] = _golden_memory(model, batch, seed)
    return inputs


@torch.no_grad()
def _golden_memory(model: WorldModel, batch: int, seed: int) -> Tensor:
    """What is remembered after some sightings of things at random places."""
    generator = torch.Generator().manual_seed(seed + 1)
    memory = torch.zeros(batch, flight.SIZE)
    pose = camera_pose(model.state_mean.expand(batch, -1), model.config.flight.camera)
    floor = Floor(torch.zeros(batch, 2, 3), torch.zeros(batch, 2))  # none is seen
    for tick in range(4):
        place = torch.tensor([3.0 - 0.16 * tick, 0.0, 0.5])
        point = place + 0.3 * torch.randn(batch, 3, generator=generator)
        seen = flight.Sighting(point, torch.full((batch,), 1e3))
        first = torch.full((batch,), tick == 0)
        memory = flight.follow(memory, pose, seen, floor, first, model.config.flight)
    return memory


@torch.no_grad()
def reference(model: WorldModel, inputs: Tensors, ensemble: Ensemble) -> dict[str, Tensors]:
    """Network -> its outputs, computed by the world model itself, not by what is exported."""
    carry = Carry(inputs["h"], inputs["z"], inputs.get("flight"))
    depth = inputs["depth"].to(torch.int32)  # as on the robot
    action, state, is_first = inputs["action"], inputs["state"], inputs["is_first"]
    observed = model.observe(carry, action, depth, state, is_first)
    imagined = model.imagine(carry, action)
    answers = {
        "observe": _named(observed),
        "imagine": _named(imagined),
        "value": {"value": judge_of(model, model.value, ensemble)(carry, action)},
        "termination": {"termination": model.termination(carry)},
    }
    if model.reward_head is not None:
        answers["reward"] = {"reward": model.reward(carry, action)}
    return answers


def _named(carry: Carry) -> Tensors:
    named = zip(("h_next", "z_next", "flight_next"), carry, strict=True)
    return {name: part for name, part in named if part is not None}


def write_graph(network: Network, inputs: Tensors, path: Path) -> None:
    """Trace ``network`` and write it to ``path``; its first axis, `batch`, is free."""
    import onnx

    arguments = tuple(inputs[name] for name in network.inputs)
    with warnings.catch_warnings():
        # The exporter that traces: the one that supersedes it needs a further package, and half a
        # minute, for graphs without any control flow.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            network.eval(),
            arguments,
            str(path),
            dynamo=False,
            opset_version=OPSET,
            input_names=list(network.inputs),
            output_names=list(network.outputs),
            dynamic_axes={name: {0: "batch"} for name in (*network.inputs, *network.outputs)},
        )
    made = onnx.load(str(path))
    with torch.no_grad():
        outputs = network(*arguments)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    for described, tensor in zip(made.graph.output, outputs, strict=True):
        # The trace forgets sizes that do not vary.
        for axis, size in zip(
            described.type.tensor_type.shape.dim[1:], tensor.shape[1:], strict=True
        ):
            axis.dim_value = size
    onnx.checker.check_model(made, full_check=True)
    onnx.save(made, str(path))
