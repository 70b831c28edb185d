"""Configuration of the world model and of its losses; every choice is one value."""

from __future__ import annotations

from dataclasses import dataclass, field

from egovcp import spec
from egovcp.errors import UsageError


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms of equations 6 to 9, and what each averages over."""

    depth: float = 30.0
    """Weight of the depth reconstruction, per pixel mean of 0.5 (x - x_hat)^2."""
    decode_every: int = 2
    """Reconstruct every n-th image of a window, the first one drawn at random: the decoder is
    the dearest part of a step, and neighbouring images teach it the same."""
    moving: float = 10.0
    """Extra weight of pixels that changed since the previous frame; 0: none."""
    flight: float = 300.0
    """Extra weight of the pixels around a thing in flight, where labels tell; 0: none."""
    moving_threshold: float = 0.04
    """Change of nearness (fraction of the depth range) that counts as moving."""
    motion: float = 10.0
    """Weight of the place of what approaches, mean squared error in half images; 0: none."""
    passing: float = 3.0
    """Weight of where and when something thrown will pass, Huber loss in units of
    `PASSING_UNIT`; 0: none."""
    state: float = 1.0
    """Weight of the proprioception reconstruction, mean over the 74 standardised values."""
    kl_prior: float = 1.0
    """Weight of KL(sg q || p), which pulls the prior to the posterior."""
    kl_posterior: float = 0.1
    """Weight of KL(q || sg p), which pulls the posterior to the prior."""
    free_nats: float = 1.0
    """KL below this many nats per step costs nothing."""
    termination: float = 1.0
    """Weight of the termination cross entropy."""
    value: float = 1.0
    """Weight of (Q - Monte Carlo return)^2, in units of the return's standard deviation."""
    imagined_steps: int = 1
    """Also regress Q on states imagined this many steps ahead of the posterior; 0: never."""
    imagined_value: float = 1.0
    """Weight of the value loss on imagined states."""
    foresight_depth: float = 30.0
    """Weight of the pictures of states imagined several ticks ahead; 0: none."""
    foresight_state: float = 1.0
    """Weight of the proprioception of states imagined several ticks ahead; 0: none."""
    foresight_ahead: tuple[int, ...] = (4, 8, 12)
    """Ticks ahead at which they are compared with what was recorded."""
    foresight_every: int = 4
    """Imagine from every n-th row of a window only, the first one drawn at random."""


@dataclass(frozen=True)
class WorldModelConfig:
    """Sizes of the networks (paper III-C) and the losses they are trained with."""

    hidden: int = 256
    """Size of the deterministic state h (GRU)."""
    latent: int = 32
    """Size of the stochastic state z (diagonal Gaussian)."""
    units: int = 256
    """Width of every MLP."""
    channels: tuple[int, int, int] = (32, 64, 64)
    """Channels of the three layers of the depth CNN; the decoder uses the last."""
    motion_ahead: tuple[int, ...] = (0, 3, 6, 9)
    """Ticks ahead at which the place of what approaches is predicted straight from the state."""
    value_state: int = 8
    """Numbers to which (h, z) is reduced for Q; 0: Q reads all of it."""
    value_of_passing: bool = True
    """Q is told what is on its way (`loss.passing` teaches it) by a head of its own."""
    min_std: float = 0.1
    """Floor of the latent standard deviation."""
    update_bias: float = -1.0
    """Bias of the GRU's update gate: memory is kept at the start of training."""
    depth_max_m: float = spec.DEPTH_MAX_M
    """Depth, in metres, at which nearness is 0."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Loss weights."""

    def __post_init__(self) -> None:
        if self.value_of_passing and self.loss.passing <= 0:
            raise UsageError(
                "value_of_passing needs loss.passing above 0: nothing else teaches Q what is on "
                "its way; set --policy.value_of_passing=false, or a weight"
            )


#: The paper's plain sum: likelihoods summed over pixels and joints, unit variances, nothing added.
PAPER_LOSS = LossConfig(
    depth=float(spec.DEPTH_ROWS * spec.DEPTH_COLS),
    decode_every=1,
    moving=0.0,
    flight=0.0,
    motion=0.0,
    passing=0.0,
    state=float(spec.STATE_DIM),
    kl_posterior=1.0,
    free_nats=0.0,
    imagined_steps=0,
    foresight_depth=0.0,
    foresight_state=0.0,
)

PRESETS = {
    "default": WorldModelConfig(),
    "paper": WorldModelConfig(value_state=0, value_of_passing=False, loss=PAPER_LOSS),
    "debug": WorldModelConfig(hidden=32, latent=8, units=32, channels=(4, 8, 8)),
}
