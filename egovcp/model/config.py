"""Configuration of the world model and of its losses; every choice is one value."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from egovcp import spec
from egovcp.bounds import bounded, check_bounds
from egovcp.errors import UsageError

#: Largest sizes of the networks; `egovcp.model.weights` also bounds their weights together.
_WIDEST = 8192
_MOST_CHANNELS = 1024
#: Longest horizon and longest list of horizons that losses and heads may have, ticks.
_FARTHEST = 1000
_LONGEST = 64

ValueLoss = Literal["mse", "two_hot"]
FreeNatsPer = Literal["step", "dimension"]
Dynamics = Literal["joint", "autoregressive"]
QTarget = Literal["mc", "td"]


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms of equations 6 to 9, and what each averages over."""

    depth: float = bounded(30.0, least=0)
    """Weight of the depth reconstruction, per pixel mean of 0.5 (x - x_hat)^2."""
    decode_every: int = bounded(2, least=1)
    """Reconstruct every n-th image of a window, the first one drawn at random: the decoder is
    the dearest part of a step, and neighbouring images teach it the same."""
    moving: float = bounded(10.0, least=0)
    """Extra weight of pixels that changed since the previous frame; 0: none."""
    moving_threshold: float = bounded(0.04, least=0, most=1)
    """Change of nearness (fraction of the depth range) that counts as moving."""
    near: float = bounded(10.0, least=0)
    """Extra weight of near pixels; 0: none."""
    near_threshold: float = bounded(0.7, least=0, most=1)
    """Nearness (1 at the camera, 0 at the end of the depth range) beyond which a pixel is near."""
    state: float = bounded(20.0, least=0)
    """Weight of the proprioception reconstruction, mean over the 74 standardised values."""
    kl_prior: float = bounded(0.1, least=0)
    """Weight of KL(sg q || p), which pulls the prior to the posterior."""
    kl_posterior: float = bounded(0.01, least=0)
    """Weight of KL(q || sg p), which pulls the posterior to the prior."""
    free_nats: float = bounded(1.0, least=0)
    """KL below this many nats per step costs nothing."""
    free_nats_per: FreeNatsPer = "step"
    """step: the free nats are for the sum over z, however it is spread; dimension: each dimension
    of z has an equal share of them to itself."""
    termination: float = bounded(1.0, least=0)
    """Weight of the termination cross entropy."""
    value: float = bounded(20.0, least=0)
    """Weight of (Q - its target)^2, in units of the return's standard deviation (see
    `value_loss`)."""
    q_target: QTarget = "mc"
    """Target of Q. mc: the Monte Carlo return; td: r + gamma Q'(h', z', a') of the next row, with
    the action that the data took there, and 0 in the place of Q' after a failure."""
    td_decay: float = bounded(0.98, least=0, below=1)
    """td: Q' is a copy of Q's heads that follows them with this decay per step; 0: the heads as
    they are, without gradient."""
    imagined_steps: int = bounded(1, least=0, most=_FARTHEST)
    """Also regress Q on states imagined this many steps ahead of the posterior; 0: never."""
    imagined_value: float = bounded(20.0, least=0)
    """Weight of the value loss on imagined states."""
    foresight_depth: float = bounded(30.0, least=0)
    """Weight of the pictures of states imagined several ticks ahead; 0: none."""
    foresight_state: float = bounded(10.0, least=0)
    """Weight of the proprioception of states imagined several ticks ahead; 0: none."""
    foresight_ahead: tuple[int, ...] = bounded(
        (4, 8, 12), least=1, most=_FARTHEST, longest=_LONGEST
    )
    """Ticks ahead at which they are compared with what was recorded."""
    foresight_every: int = bounded(4, least=1)
    """Imagine from every n-th row of a window only, the first one drawn at random."""
    autoregressive_steps: int = bounded(8, least=1, most=_FARTHEST)
    """`dynamics` autoregressive: ticks over which predictions are fed back, all of them compared
    with what was recorded; from the rows that `foresight_every` says."""
    reward: float = bounded(0.0, least=0)
    """Weight of the reward predicted from (h, z, a), mean squared error in units of the return's
    standard deviation, on the states that Q is trained on; 0: there is no such head."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True)
class WorldModelConfig:
    """Sizes of the networks (paper III-C) and the losses they are trained with."""

    hidden: int = bounded(256, least=1, most=_WIDEST)
    """Size of the deterministic state h (GRU)."""
    latent: int = bounded(32, least=1, most=_WIDEST)
    """Size of the stochastic state z (diagonal Gaussian)."""
    units: int = bounded(256, least=1, most=_WIDEST)
    """Width of every MLP."""
    channels: tuple[int, int, int] = bounded((32, 64, 64), least=1, most=_MOST_CHANNELS)
    """Channels of the three layers of the depth CNN; the decoder uses the last."""
    dynamics: Dynamics = "joint"
    """How the dynamics are learned. joint: equation 8, prior and posterior are pulled to each
    other; autoregressive: predictions are fed back for several ticks and compared with the
    recorded observations instead (the baseline ARWM), with no KL at all."""
    value_loss: ValueLoss = "two_hot"
    """mse: Q is a number, fitted by its squared error; two_hot: a distribution over bins of
    symlog returns, fitted by cross entropy, whose mean is the number."""
    min_std: float = bounded(0.1, least=1e-6, most=10)
    """Floor of the latent standard deviation."""
    update_bias: float = bounded(-1.0, least=-20, most=20)
    """Bias of the GRU's update gate: memory is kept at the start of training."""
    depth_max_m: float = bounded(spec.DEPTH_MAX_M, least=0.1, most=100)
    """Depth, in metres, at which nearness is 0."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Loss weights."""

    def __post_init__(self) -> None:
        check_bounds(self)


def require_longer(window: int, steps: int, flag: str) -> None:
    """Raise `UsageError`, which names the ``flag`` of the window, if predictions would be fed back
    beyond every window of so many ticks."""
    if window <= steps:
        raise UsageError(
            f"{flag}={window}: autoregressive training compares predictions up to "
            f"{steps} ticks ahead (loss.autoregressive_steps); give longer windows, or fewer steps"
        )


#: The paper's plain sum: likelihoods summed over pixels and joints, unit variances, nothing added.
PAPER_LOSS = LossConfig(
    depth=float(spec.DEPTH_ROWS * spec.DEPTH_COLS),
    decode_every=1,
    moving=0.0,
    near=0.0,
    state=float(spec.STATE_DIM),
    kl_prior=1.0,
    kl_posterior=1.0,
    free_nats=0.0,
    value=1.0,
    imagined_steps=0,
    foresight_depth=0.0,
    foresight_state=0.0,
)

PRESETS = {
    "default": WorldModelConfig(),
    "paper": WorldModelConfig(value_loss="mse", loss=PAPER_LOSS),
    "debug": WorldModelConfig(hidden=32, latent=8, units=32, channels=(4, 8, 8)),
}
