"""The building blocks: MLPs, the depth CNN and its mirror image, and the GRU cell."""

from __future__ import annotations

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
        reset, candidate, update = self.norm(self.project(torch.cat([x, h], -1))).chunk(
            3, -1
        )
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        gate = torch.sigmoid(update + self.update_bias)
        return torch.lerp(h, candidate.to(h.dtype), gate.to(h.dtype))


def feature_shape(channels: tuple[int, ...]) -> tuple[int, int, int]:
    """(C, H, W) of the innermost feature map of the depth CNN."""
    halvings = 2 ** len(channels)
    return channels[-1], spec.DEPTH_ROWS // halvings, spec.DEPTH_COLS // halvings


class DepthEncoder(nn.Module):
    """Image of nearness and validity (B, 2, 48, 64) -> features (B, C*H*W)."""

    def __init__(self, channels: tuple[int, ...]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in zip((2, *channels[:-1]), channels, strict=True):
            layers += [nn.Conv2d(inputs, outputs, 4, stride=2, padding=1), nn.SiLU()]
        self.layers = nn.Sequential(*layers)
        self.outputs = int(torch.tensor(feature_shape(channels)).prod())

    def forward(self, image: Tensor) -> Tensor:
        features: Tensor = self.layers(
            image.contiguous(memory_format=torch.channels_last)
        )
        return features.flatten(1)


class DepthDecoder(nn.Module):
    """State features (B, inputs) -> nearness image (B, 48, 64)."""

    def __init__(self, inputs: int, channels: tuple[int, ...]) -> None:
        super().__init__()
        self.shape = feature_shape(channels)
        self.project = nn.Linear(inputs, int(torch.tensor(self.shape).prod()))
        layers: list[nn.Module] = []
        reverse = channels[::-1]
        for i, (n_in, n_out) in enumerate(zip(reverse, (*reverse[1:], 1), strict=True)):
            layers.append(nn.ConvTranspose2d(n_in, n_out, 4, stride=2, padding=1))
            if i < len(reverse) - 1:
                layers.append(nn.SiLU())
        self.layers = nn.Sequential(*layers)

    def forward(self, features: Tensor) -> Tensor:
        maps = self.project(features).view(-1, *self.shape)
        image: Tensor = self.layers(maps.contiguous(memory_format=torch.channels_last))
        return image.squeeze(1)
