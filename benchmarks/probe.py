"""Regression of a return on whatever a row is said to be: an upper estimate, honestly judged.

Several small networks, each on its own set of inputs, stop where they are best on episodes kept
from them; the best of them, or the average of the best few, is chosen on those same episodes.
The episodes on which it is judged take no part in any of this.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

type Array = NDArray[np.float32]

_CLIP = 8.0  # deviations


@dataclass(frozen=True)
class ProbeConfig:
    """How long, and with what, the probes are fitted."""

    steps: int = 1000
    """Gradient steps of each network at most."""
    rows: int = 1024
    """Rows per step."""
    lr: float = 2e-3
    """Peak learning rate; one cycle."""
    weight_decay: float = 0.05
    """Decoupled weight decay."""
    dropout: float = 0.1
    """Share of hidden units left out at each step."""
    hidden: tuple[int, ...] = (64, 256)
    """Widths to try, each with every set of inputs."""
    check_every: int = 50
    """Steps between looks at the validation episodes."""
    patience: int = 8
    """Looks without progress after which a fit ends."""
    average: int = 3
    """At most so many of the best networks are averaged."""
    seed: int = 0
    """Of starts and batches."""


class Data(NamedTuple):
    """Rows to learn from or to judge on."""

    inputs: Mapping[str, Array]
    """Name of a set of inputs -> (N, width)."""
    target: Array
    """(N,)."""
    mirror: Mapping[str, Array] | None = None
    """The inputs in the mirror, whose target is the same; None: there is none."""


class Fitted(NamedTuple):
    """One network's guesses."""

    name: str
    r2: float
    """On the validation rows."""
    validation: Array
    """(V,)."""
    judged: Array
    """(J,)."""


class Guess(NamedTuple):
    """What the probe says."""

    name: str
    """Sets of inputs and widths that were chosen."""
    r2: float
    """On the validation rows, on which it was chosen."""
    value: Array
    """(J,) for the rows it is judged on."""


def explained(value: Array, target: Array) -> float:
    """Share of the variance of the target that ``value`` explains; below 0 if it is worse than
    the mean."""
    spread = float(np.var(target, dtype=np.float64))
    return 1 - float(np.square(value - target, dtype=np.float64).mean()) / max(spread, 1e-12)


def probe(fit: Data, validation: Data, judged: Data, config: ProbeConfig) -> Guess:
    """Fit the candidates and let the best of them judge."""
    found = [
        _fitted(name, width, fit, validation, judged, config)
        for name in fit.inputs
        for width in config.hidden
    ]
    found.sort(key=lambda f: f.r2, reverse=True)
    guesses = [_average(found[:n], validation) for n in range(1, config.average + 1)]
    return max(guesses, key=lambda guess: guess.r2)


def _average(found: Sequence[Fitted], validation: Data) -> Guess:
    r2 = explained(np.mean([f.validation for f in found], axis=0), validation.target)
    value = np.mean([f.judged for f in found], axis=0)
    return Guess(" + ".join(f.name for f in found), r2, value)


def _fitted(
    name: str, width: int, fit: Data, validation: Data, judged: Data, config: ProbeConfig
) -> Fitted:
    """Fit one network on one set of inputs."""
    torch.manual_seed(config.seed)
    scale = _Scale(fit.inputs[name], fit.target)
    x, y = scale(fit.inputs[name]), (torch.from_numpy(fit.target) - scale.offset) / scale.spread
    other = x if fit.mirror is None else scale(fit.mirror[name])
    seen, judge = scale(validation.inputs[name]), scale(judged.inputs[name])
    net = network(x.shape[1], width, config.dropout)

    def guess(inputs: Tensor) -> Array:
        net.eval()
        with torch.no_grad():
            parts = [net(part).squeeze(-1) for part in torch.split(inputs, 8192)]
        net.train()
        value: Array = (torch.cat(parts) * scale.spread + scale.offset).numpy()
        return value

    best = Fitted("", -np.inf, fit.target, fit.target)
    weights: dict[str, Any] = {}
    idle = 0
    for step in _descend(net, x, other, y, config):
        if step % config.check_every:
            continue
        value = guess(seen)
        r2 = explained(value, validation.target)
        idle = 0 if r2 > best.r2 else idle + 1
        if r2 > best.r2:
            best = Fitted(f"{name} {width}", r2, value, best.judged)
            weights = copy.deepcopy(net.state_dict())
        if idle >= config.patience:
            break
    net.load_state_dict(weights)
    return best._replace(judged=guess(judge))


def _descend(
    net: nn.Module, x: Tensor, other: Tensor, y: Tensor, config: ProbeConfig
) -> Iterator[int]:
    """Gradient steps, numbered from 1; half of the rows are seen in the mirror."""
    generator = torch.Generator().manual_seed(config.seed)
    optimizer = torch.optim.AdamW(net.parameters(), lr=config.lr, weight_decay=config.weight_decay)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.lr, total_steps=config.steps)
    for step in range(1, config.steps + 1):
        pick = torch.randint(len(y), (config.rows,), generator=generator)
        half = config.rows // 2
        rows = torch.cat([x[pick[:half]], other[pick[half:]]])
        optimizer.zero_grad(set_to_none=True)
        (net(rows).squeeze(-1) - y[pick]).square().mean().backward()
        optimizer.step()
        cycle.step()
        yield step


def network(inputs: int, width: int, dropout: float) -> nn.Sequential:
    """Two hidden layers."""
    layers: list[nn.Module] = []
    for size in (inputs, width):
        layers += [nn.Linear(size, width), nn.LayerNorm(width), nn.SiLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers, nn.Linear(width, 1))


class _Scale:
    """Standardises inputs and target by the rows that are learned from."""

    def __init__(self, inputs: Array, target: Array) -> None:
        self._mean = inputs.mean(axis=0, dtype=np.float64).astype(np.float32)
        self._std = np.maximum(inputs.std(axis=0, dtype=np.float64), 1e-4).astype(np.float32)
        self.offset, self.spread = float(target.mean()), max(float(target.std()), 1e-6)

    def __call__(self, inputs: Array) -> Tensor:
        """(N, width) deviations from the mean."""
        return torch.from_numpy(((inputs - self._mean) / self._std).clip(-_CLIP, _CLIP))
