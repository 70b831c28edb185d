"""Building blocks: MLPs, the depth encoder and decoder, and the GRU cell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from egovcp.robot_spec import G1, PATCH


class SplitLinear(nn.Module):
    """A Linear on the concatenation of several inputs, computed part by part.

    Leading dimensions of the parts broadcast: a state shared by many candidate actions is
    multiplied once, and the part of an observation can be computed for all steps before a
    recurrence.
    """

    def __init__(self, inputs: Sequence[int], outputs: int) -> None:
        super().__init__()
        self.parts = nn.ModuleList(nn.Linear(n, outputs, bias=False) for n in inputs)
        bound = sum(inputs) ** -0.5  # of the weights of one Linear on the concatenation
        for part in self.parts:
            nn.init.uniform_(part.weight, -bound, bound)  # type: ignore[arg-type]

    def forward(self, *inputs: Tensor) -> Tensor:
        """One tensor (..., n_i) per part -> (..., outputs)."""
        total: Tensor = self.parts[0](inputs[0])
        for part, x in zip(self.parts[1:], inputs[1:], strict=True):
            total = total + part(x)
        return total


class SplitMlp(nn.Module):
    """``hidden_layers`` of Linear + LayerNorm + SiLU on several inputs, then a Linear."""

    def __init__(
        self, inputs: Sequence[int], units: int, outputs: int, hidden_layers: int = 1
    ) -> None:
        super().__init__()
        self.first = SplitLinear(inputs, units)
        layers: list[nn.Module] = []
        for _ in range(hidden_layers - 1):
            layers += [nn.LayerNorm(units), nn.SiLU(), nn.Linear(units, units, bias=False)]
        self.rest = nn.Sequential(
            *layers, nn.LayerNorm(units), nn.SiLU(), nn.Linear(units, outputs)
        )

    def start_at_zero(self) -> None:
        """Make the last layer zero."""
        last = self.rest[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, *inputs: Tensor) -> Tensor:
        """One tensor (..., n_i) per input -> (..., outputs)."""
        outputs: Tensor = self.rest(self.first(*inputs))
        return outputs


class GruCell(nn.Module):
    """A GRU cell with one normalised projection of input and h (equation 1).

    A negative ``update_bias`` makes the update gate keep ``h`` initially, so that gradients reach
    far back from the first training step.
    """

    def __init__(self, inputs: int, hidden: int, update_bias: float) -> None:
        super().__init__()
        self.update_bias = update_bias
        self.project = SplitLinear((inputs, hidden), 3 * hidden)
        self.norm = nn.LayerNorm(3 * hidden)

    def forward(self, x: Tensor, h: Tensor) -> Tensor:
        """(..., inputs), (..., hidden) -> (..., hidden)."""
        reset, candidate, update = self.norm(self.project(x, h)).chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        gate = torch.sigmoid(update + self.update_bias)
        return torch.lerp(h, candidate.to(h.dtype), gate.to(h.dtype))


class DepthEncoder(nn.Module):
    """Image of nearness and validity (B, 2, H, W) -> features (B, C * H / 16 * W / 16).

    The stem has overlapping 8 x 8 patches at stride 4: on a CPU a third of the cost of two
    stride-2 layers.
    """

    def __init__(self, channels: tuple[int, int, int], shape: tuple[int, int] = G1.depth) -> None:
        super().__init__()
        stem, middle, last = channels
        self.layers = nn.Sequential(
            nn.Conv2d(2, stem, 8, stride=4, padding=2),
            nn.SiLU(),
            nn.Conv2d(stem, middle, 3, stride=2, padding=1),
            nn.SiLU(),
            nn.Conv2d(middle, last, 3, stride=2, padding=1),
            nn.SiLU(),
            nn.Flatten(),
        )
        self.outputs = last * (shape[0] // PATCH) * (shape[1] // PATCH)

    def forward(self, image: Tensor) -> Tensor:
        features: Tensor = self.layers(image.contiguous(memory_format=torch.channels_last))
        return features


class DepthDecoder(nn.Module):
    """State features (B, inputs) -> nearness image (B, H, W).

    A map of H / 8 x W / 8 cells; each is decoded to 8 x 8 pixels.
    """

    PATCH = 8

    def __init__(self, inputs: int, channels: int, shape: tuple[int, int] = G1.depth) -> None:
        super().__init__()
        self.image = shape
        self.shape = (channels, shape[0] // self.PATCH, shape[1] // self.PATCH)
        self.project = nn.Linear(inputs, math.prod(self.shape))
        self.layers = nn.Sequential(
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(channels, self.PATCH**2, 1),
        )

    def forward(self, features: Tensor) -> Tensor:
        maps = self.project(features).view(-1, *self.shape)
        patches: Tensor = self.layers(maps.contiguous(memory_format=torch.channels_last))
        # The same as `F.pixel_shuffle`, three times as fast on a CPU.
        rows, cols = self.shape[1:]
        cells = patches.permute(0, 2, 3, 1).reshape(-1, rows, cols, self.PATCH, self.PATCH)
        return cells.transpose(2, 3).reshape(-1, *self.image)
