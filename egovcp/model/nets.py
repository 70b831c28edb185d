"""The building blocks: MLPs, the depth CNN and its mirror image, and the GRU cell."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from egovcp import spec


def mlp(inputs: int, units: int, outputs: int, hidden_layers: int) -> nn.Sequential:
    """``hidden_layers`` of Linear + LayerNorm + SiLU, then a Linear to ``outputs``."""
    layers: list[nn.Module] = []
    for _ in range(hidden_layers):
        layers += [nn.Linear(inputs, units, bias=False), nn.LayerNorm(units), nn.SiLU()]
        inputs = units
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


class GruCell(nn.Module):
    """A GRU cell with one normalised projection of [input, h] (equation 1).

    The update gate starts biased towards keeping ``h``, so that gradients reach far
    back from the first step of training.
    """

    def __init__(self, inputs: int, hidden: int, update_bias: float) -> None:
        super().__init__()
        self.update_bias = update_bias
        self.project = nn.Linear(inputs + hidden, 3 * hidden, bias=False)
        self.norm = nn.LayerNorm(3 * hidden)

    def forward(self, x: Tensor, h: Tensor) -> Tensor:
        """(B, inputs), (B, hidden) -> (B, hidden)."""
        reset, candidate, update = self.norm(self.project(torch.cat([x, h], -1))).chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        gate = torch.sigmoid(update + self.update_bias)
        return torch.lerp(h, candidate.to(h.dtype), gate.to(h.dtype))


class DepthEncoder(nn.Module):
    """Image of nearness and validity (B, 2, 48, 64) -> features (B, C * 3 * 4).

    The stem reads overlapping 8 x 8 patches on a grid of 4 pixels: a third of the cost of
    two stride-2 layers on a CPU, and a distant ball, 3 pixels wide, still fills a patch.
    """

    def __init__(self, channels: tuple[int, int, int]) -> None:
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
        self.outputs = last * (spec.DEPTH_ROWS // 16) * (spec.DEPTH_COLS // 16)

    def forward(self, image: Tensor) -> Tensor:
        features: Tensor = self.layers(image.contiguous(memory_format=torch.channels_last))
        return features


class DepthDecoder(nn.Module):
    """State features (B, inputs) -> nearness image (B, 48, 64).

    A map of 6 x 8 cells, each of which paints its own 8 x 8 pixels.
    """

    PATCH = 8

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.shape = (channels, spec.DEPTH_ROWS // self.PATCH, spec.DEPTH_COLS // self.PATCH)
        self.project = nn.Linear(inputs, math.prod(self.shape))
        self.layers = nn.Sequential(
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(channels, self.PATCH**2, 1),
            nn.PixelShuffle(self.PATCH),
        )

    def forward(self, features: Tensor) -> Tensor:
        maps = self.project(features).view(-1, *self.shape)
        image: Tensor = self.layers(maps.contiguous(memory_format=torch.channels_last))
        return image.squeeze(1)
