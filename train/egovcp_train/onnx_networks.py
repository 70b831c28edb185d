"""The networks that the planner calls, as graphs: one tick, a batch of independent rows.

    observe      h, z, action, depth, state, is_first  ->  h_next, z_next
    imagine      h, z, action                          ->  h_next, z_next
    value        h, z, action                          ->  value
    termination  h, z                                  ->  termination
    reward       h, z, action                          ->  reward         if it is predicted

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
from egovcp.model import Carry, WorldModel

OPSET: Final = 17

type Tensors = dict[str, Tensor]


class Network(nn.Module):
    """A graph; its inputs and outputs in the order of the names."""

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.model = model


class Observe(Network):
    """`WorldModel.observe`: depth (B, 48, 64) mm as float32, whole numbers, 0 = not measured."""

    inputs = ("h", "z", "action", "depth", "state", "is_first")
    outputs = ("h_next", "z_next")

    def forward(
        self, h: Tensor, z: Tensor, action: Tensor, depth: Tensor, state: Tensor, is_first: Tensor
    ) -> Carry:
        near = pooled_nearness(depth, self.model.config.depth_max_m)
        return self.model.observe_near(Carry(h, z), action, near, state, is_first)


class Imagine(Network):
    """`WorldModel.imagine`."""

    inputs = ("h", "z", "action")
    outputs = ("h_next", "z_next")

    def forward(self, h: Tensor, z: Tensor, action: Tensor) -> Carry:
        return self.model.imagine(Carry(h, z), action)


class Value(Network):
    """`WorldModel.value`, (B,)."""

    inputs = ("h", "z", "action")
    outputs = ("value",)

    def forward(self, h: Tensor, z: Tensor, action: Tensor) -> Tensor:
        return self.model.value(Carry(h, z), action)


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


NETWORKS: Final[Mapping[str, type[Network]]] = {
    "observe": Observe,
    "imagine": Imagine,
    "value": Value,
    "termination": Termination,
}
REWARD: Final[Mapping[str, type[Network]]] = {"reward": Reward}


def networks_of(model: WorldModel) -> Mapping[str, type[Network]]:
    """The networks of this model, by name."""
    return {**NETWORKS, **({} if model.reward_head is None else REWARD)}


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
    return {
        "h": normal(model.config.hidden).tanh(),
        "z": normal(model.config.latent),
        "action": 2.0 * uniform(spec.ACTION_DIM) - 1.0,
        "depth": depth.masked_fill(uniform(*image) < 0.1, 0.0),
        "state": model.state_mean + 3.0 * model.state_std * normal(spec.STATE_DIM),
        "is_first": torch.arange(batch) % 3 == 0,
    }


@torch.no_grad()
def reference(model: WorldModel, inputs: Tensors) -> dict[str, Tensors]:
    """Network -> its outputs, computed by the world model itself, not by the exported modules."""
    carry = Carry(inputs["h"], inputs["z"])
    depth = inputs["depth"].to(torch.int32)  # as on the robot
    action, state, is_first = inputs["action"], inputs["state"], inputs["is_first"]
    observed = model.observe(carry, action, depth, state, is_first)
    imagined = model.imagine(carry, action)
    answers = {
        "observe": _named(observed),
        "imagine": _named(imagined),
        "value": {"value": model.value(carry, action)},
        "termination": {"termination": model.termination(carry)},
    }
    if model.reward_head is not None:
        answers["reward"] = {"reward": model.reward(carry, action)}
    return answers


def _named(carry: Carry) -> Tensors:
    return {"h_next": carry.h, "z_next": carry.z}


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
