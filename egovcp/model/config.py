"""Configuration of the world model and of its losses; every choice is one value."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from egovcp import spec
from egovcp.bounds import bounded, check_bounds
from egovcp.errors import UsageError

#: Largest sizes of the networks; `egovcp.model.weights` also bounds their weights together.
_WIDEST = 8192
_MOST_CHANNELS = 1024
_MOST_HEADS = 64
#: Longest horizon and longest list of horizons that losses and heads may have, ticks.
_FARTHEST = 1000
_LONGEST = 64

ValueLoss = Literal["mse", "two_hot"]
FreeNatsPer = Literal["step", "dimension"]
Dynamics = Literal["joint", "autoregressive"]
QTarget = Literal["mc", "td"]
AxisPrior = tuple[float, float, float, float, float]
Ages = tuple[float, float, float, float]
AGES = 4  #: of pictures, that are thought possible


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
    flight: float = bounded(300.0, least=0)
    """Extra weight of the pixels around a thing in flight, where labels tell, if it is not painted
    (`paint_flight`); 0: none."""
    moving_threshold: float = bounded(0.04, least=0, most=1)
    """Change of nearness (fraction of the depth range) that counts as moving."""
    near: float = bounded(10.0, least=0)
    """Extra weight of near pixels; 0: none."""
    near_threshold: float = bounded(0.7, least=0, most=1)
    """Nearness (1 at the camera, 0 at the end of the depth range) beyond which a pixel is near."""
    motion: float = bounded(10.0, least=0)
    """Weight of the place in the picture of what flies, where labels tell, Huber loss in half
    pictures; 0: none."""
    passing: float = bounded(3.0, least=0)
    """Weight of where and when something thrown will pass, Huber loss in units of
    `PASSING_UNIT`; 0: none."""
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
    value: float = bounded(1.0, least=0)
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
    imagined_value: float = bounded(1.0, least=0)
    """Weight of the value loss on imagined states."""
    foresight_depth: float = bounded(30.0, least=0)
    """Weight of the pictures of states imagined several ticks ahead; 0: none."""
    foresight_state: float = bounded(10.0, least=0)
    """Weight of the proprioception of states imagined several ticks ahead; 0: none."""
    foresight_motion: float = bounded(10.0, least=0)
    """Weight of the place of what flies in states imagined several ticks ahead; 0: none."""
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
class CameraGeometry:
    """Where the camera sits, as far as the robot knows."""

    position: tuple[float, float, float] = bounded((0.058, 0.0, 0.42), least=-1, most=1)
    """Mount in the torso frame, m (the simulator's default)."""
    pitch: float = bounded(math.radians(-2.5), least=-math.pi / 2, most=math.pi / 2)
    """Tilt below the torso's horizontal, rad (the middle of the simulator's range)."""
    vertical_fov: float = bounded(
        math.radians(58.0), least=math.radians(10.0), most=math.radians(150.0)
    )
    """Vertical field of view, rad; pixels are square."""

    @property
    def half_height(self) -> float:
        """Of the picture, in focal lengths."""
        return math.tan(self.vertical_fov / 2)


@dataclass(frozen=True)
class FlightConfig:
    """The filter that follows what is thrown (`egovcp.model.flight`)."""

    enabled: bool = True
    """Q is told the path that the filter follows; else what the state says of it."""
    camera: CameraGeometry = field(default_factory=CameraGeometry)
    """Of the recordings."""
    plane: float = bounded(0.32, above=0, most=2)
    """The plane, before the pelvis, whose crossing is told, m."""
    picture_ages: Ages = bounded((0.02, 0.04, 0.06, 0.08), least=0, most=2 * spec.PLANNER_DT)
    """How much older than the state beside it a picture may be, s, at most two ticks; the floor
    says how likely each is (`egovcp.model.picture_age`)."""
    age_deviation: float = bounded(0.03, least=1e-4, most=10)
    """By how much the floor may seem to rise and sink in the pictures that count, m: with a tenth
    of it the stillest floor alone is believed, with ten times as much all ages alike."""
    age_memory: float = bounded(0.95, least=0, most=1)
    """What one picture says of their age counts for so much less with each tick."""
    radius: float = bounded(0.10, least=0, most=1)
    """What is added to the depth of a surface to reach the middle of the thing, m."""
    search: float = bounded(0.25, least=0.01, most=5)
    """Pixels this near the place that the encoder sees, across and in depth, are its own, m."""
    deviation: float = bounded(0.01, least=1e-4, most=1)
    """Deviation of a sighting, m per m of distance."""
    prior: tuple[AxisPrior, AxisPrior, AxisPrior] = bounded(
        (
            (2.9, -3.5, 7.8, 1.2, 2.4),
            (0.0, 0.0, 5.6, 1.1, 0.5),
            (0.4, 3.5, 8.7, -0.3, 1.6),
        ),
        least=-1000,
        most=1000,
    )
    """Of place and velocity at the first sighting, forward, left and up: mean place (m), mean speed
    (m/s), and the precision's (place, place), (place, speed), (speed, speed); of 254 throws of the
    default task."""
    aim: tuple[tuple[float, float], tuple[float, float]] = bounded(
        ((0.0, 0.24), (0.45, 0.18)), least=-10, most=10
    )
    """Mean and deviation of y and z where throws cross the plane, m."""
    doubt: float = bounded(2.0, least=0.01, most=1000)
    """The variance of a crossing is this many times what independent sightings would give."""
    gate: float = bounded(0.5, least=0.01, most=100)
    """A sighting farther than this from the path of three or more is not its own, m."""
    painted: float = bounded(0.25, least=0, most=1)
    """A path at least so sure says where it is painted (`paint_flight`); else `motion` does."""
    forget: float = bounded(0.5, least=0, most=60)
    """A path whose thing has not been seen for so long is forgotten, s."""

    def __post_init__(self) -> None:
        check_bounds(self)
        for mean in self.aim:
            if mean[1] <= 0:
                raise UsageError(
                    f"aim {list(mean)}: the second number, a deviation, must be above 0"
                )
        for axis in self.prior:
            place, both, speed = axis[2:]
            if place <= 0 or speed <= 0 or place * speed <= both**2:
                raise UsageError(
                    f"prior {list(axis)}: the last three numbers must be a positive definite matrix"
                )


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
    motion_ahead: tuple[int, ...] = bounded((0, 3, 6, 9), least=0, most=_FARTHEST, longest=_LONGEST)
    """Ticks ahead at which the place of what flies is predicted straight from the state; the first
    is 0, now."""
    paint_flight: bool = True
    """What flies is painted as a disc where the state says that it is (`loss.motion` teaches it),
    over the picture that the decoder paints."""
    dynamics: Dynamics = "joint"
    """How the dynamics are learned. joint: equation 8, prior and posterior are pulled to each
    other; autoregressive: predictions are fed back for several ticks and compared with the
    recorded observations instead (the baseline ARWM), with no KL at all."""
    value_state: int = bounded(8, least=0, most=_WIDEST)
    """Numbers to which (h, z) is reduced for Q; 0: Q reads all of it."""
    value_of_passing: bool = True
    """Q is told what is on its way (`loss.passing` teaches it) by a head of its own."""
    value_loss: ValueLoss = "mse"
    """mse: Q is a number, fitted by its squared error; two_hot: a distribution over bins of
    symlog returns, fitted by cross entropy, whose mean is the number."""
    q_heads: int = bounded(1, least=1, most=_MOST_HEADS)
    """Heads of Q that differ in their start. A search finds what one of them is wrong about; where
    the least of them is high, none says otherwise (`planner.ensemble`)."""
    value_units: int = bounded(0, least=0, most=_WIDEST)
    """Width of a head of Q, half of it for the part that is told what is on its way; 0: `units`."""
    flight: FlightConfig = field(default_factory=FlightConfig)
    """Follows what is thrown at the robot; only where `value_of_passing`."""
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
        if self.value_of_passing and self.loss.passing <= 0:
            raise UsageError(
                "value_of_passing needs loss.passing above 0: nothing else teaches Q what is on "
                "its way; set --policy.value_of_passing=false, or a weight"
            )
        if self.paint_flight and self.loss.motion <= 0:
            raise UsageError(
                "paint_flight needs loss.motion above 0: nothing else teaches the place of what "
                "flies; set --policy.paint_flight=false, or a weight"
            )
        if self.follows_flight and self.loss.motion <= 0:
            raise UsageError(
                "flight.enabled needs loss.motion above 0: nothing else teaches the encoder to see "
                "what flies; set --policy.flight.enabled=false, or a weight"
            )
        if self.paint_flight and self.motion_ahead[:1] != (0,):
            raise UsageError(
                f"motion_ahead {list(self.motion_ahead)}: with paint_flight the first must be 0, "
                "the place that is painted; put it there, or set --policy.paint_flight=false"
            )

    @property
    def follows_flight(self) -> bool:
        """Whether there is a filter."""
        return self.flight.enabled and self.value_of_passing


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
    flight=0.0,
    motion=0.0,
    passing=0.0,
    state=float(spec.STATE_DIM),
    kl_prior=1.0,
    kl_posterior=1.0,
    free_nats=0.0,
    imagined_steps=0,
    foresight_depth=0.0,
    foresight_state=0.0,
    foresight_motion=0.0,
)

PRESETS = {
    "default": WorldModelConfig(),
    "paper": WorldModelConfig(
        value_state=0,
        value_of_passing=False,
        paint_flight=False,
        flight=FlightConfig(enabled=False),
        loss=PAPER_LOSS,
    ),
    "debug": WorldModelConfig(hidden=32, latent=8, units=32, q_heads=2, channels=(4, 8, 8)),
}
