"""Configuration of the world model and of its losses; every choice is one value."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, Self

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
DynamicsLoss = Literal["joint", "autoregressive"]
QTarget = Literal["privileged", "mc", "td"]


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms (equations 6 to 9) and what each averages over."""

    depth: float = bounded(30.0, least=0)
    """Weight of the depth reconstruction, mean over pixels of 0.5 (x - x_hat)^2."""
    decode_every: int = bounded(2, least=1)
    """Reconstruct every n-th image of a window, starting at a random one."""
    motion_weight: float = bounded(10.0, least=0)
    """Extra weight of pixels that changed since the previous image; 0: none."""
    motion_threshold: float = bounded(0.04, least=0, most=1)
    """Change of nearness, as a fraction of the depth range, that counts as motion."""
    proximity_weight: float = bounded(10.0, least=0)
    """Extra weight of near pixels; 0: none."""
    proximity_threshold: float = bounded(0.7, least=0, most=1)
    """Nearness (1 at the camera, 0 at the end of the depth range) above which a pixel is near."""
    state: float = bounded(20.0, least=0)
    """Weight of the proprioception reconstruction, mean over the standardised values."""
    kl_prior: float = bounded(0.1, least=0)
    """Weight of KL(sg q || p), which trains the prior."""
    kl_posterior: float = bounded(0.01, least=0)
    """Weight of KL(q || sg p), which regularises the posterior."""
    free_nats: float = bounded(1.0, least=0)
    """Clip each KL term below at this many nats per step."""
    free_nats_per: FreeNatsPer = "step"
    """step: clip the sum over the dimensions of z; dimension: clip each one at an equal share."""
    termination: float = bounded(1.0, least=0)
    """Weight of the termination cross-entropy."""
    value: float = bounded(20.0, least=0)
    """Weight of the value loss on filtered states, in standard deviations of the return."""
    q_target: QTarget = "privileged"
    """Target of Q. privileged: a critic that sees the position of the task's object and predicts
    the value of planned actions (mc if the data lacks the position); mc: Monte Carlo return; td:
    r + gamma Q'(h', z', a') with the next action of the data, 0 instead of Q' after a failure."""
    sampled_actions: int = bounded(7, least=0, most=1000)
    """privileged: actions per row to which Q is fitted besides the recorded one, and of which the
    critic's target takes the best."""
    td_decay: float = bounded(0.98, least=0, below=1)
    """td: decay per step of the target network Q'; 0: no target network."""
    imagined_steps: int = bounded(1, least=0, most=_FARTHEST)
    """Also train Q on states imagined this many steps ahead of the posterior; 0: never."""
    imagined_value: float = bounded(20.0, least=0)
    """Weight of the value loss on imagined states."""
    multistep_depth: float = bounded(30.0, least=0)
    """Weight of the depth reconstruction of states imagined several steps ahead; 0: none."""
    multistep_state: float = bounded(10.0, least=0)
    """Weight of the proprioception of states imagined several steps ahead; 0: none."""
    multistep_horizons: tuple[int, ...] = bounded(
        (4, 8, 12), least=1, most=_FARTHEST, longest=_LONGEST
    )
    """Steps ahead at which imagined states are compared with the recorded observations."""
    multistep_stride: int = bounded(4, least=1)
    """Imagine from every n-th row of a window, starting at a random one."""
    autoregressive_steps: int = bounded(8, least=1, most=_FARTHEST)
    """Steps over which predictions are fed back under `dynamics=autoregressive`, from every
    `multistep_stride`-th row."""
    object: float = bounded(10.0, least=0)
    """Weight of the position and velocity of the task's object, decoded from (h, z) where the data
    has them, mean over the six standardised values; 0: none."""
    multistep_object: float = bounded(10.0, least=0)
    """Weight of the same on states imagined several steps ahead; 0: none."""
    reward: float = bounded(0.0, least=0)
    """Weight of the reward prediction from (h, z, a), squared error in standard deviations of the
    return; 0: no reward head."""

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
    dynamics: DynamicsLoss = "joint"
    """joint: train prior and posterior by the KL terms of equation 8; autoregressive: feed
    predictions back for several steps and compare them with the observations (ARWM), no KL."""
    value_loss: ValueLoss = "mse"
    """mse: Q is a number, trained by its squared error; two_hot: Q is a distribution over bins of
    symlog returns, trained by cross-entropy, which suits noisy targets (q_target=mc)."""
    min_std: float = bounded(0.1, least=1e-6, most=10)
    """Smallest standard deviation of z."""
    update_bias: float = bounded(-1.0, least=-20, most=20)
    """Initial bias of the GRU's update gate; negative: keep the memory."""
    depth_max_m: float = bounded(spec.DEPTH_MAX_M, least=0.1, most=100)
    """Depth at which nearness is 0, m."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Loss weights."""

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def predicts_object(self) -> bool:
        """Whether a decoder of the object's position is trained."""
        return self.loss.object > 0 or self.loss.multistep_object > 0

    def without_object(self) -> Self:
        """The same without a decoder of the object's position."""
        return replace(self, loss=replace(self.loss, object=0.0, multistep_object=0.0))


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
    motion_weight=0.0,
    proximity_weight=0.0,
    state=float(spec.STATE_DIM),
    kl_prior=1.0,
    kl_posterior=1.0,
    free_nats=0.0,
    value=1.0,
    q_target="mc",
    imagined_steps=0,
    multistep_depth=0.0,
    multistep_state=0.0,
    object=0.0,
    multistep_object=0.0,
)

PRESETS = {
    "default": WorldModelConfig(),
    "paper": WorldModelConfig(loss=PAPER_LOSS),
    "debug": WorldModelConfig(hidden=32, latent=8, units=32, channels=(4, 8, 8)),
}
