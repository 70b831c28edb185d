"""The ego-vision world model (paper section III-C).

    h_t = f(h_{t-1}, z_{t-1}, a_{t-1})        (1)   deterministic state, GRU
    z_t ~ q(z | h_t, o_t)                     (2)   posterior, from depth and proprioception
    o_t ~ p(o | h_t, z_t)                     (3)   decoder
    z^_t ~ p(z | h_t)                               prior, without the observation
    d_t = D(h_t, z_t)                         (4)   probability of termination
    Q_t = Q(h_t, z_t, a_t)                    (5)   surrogate value

Leading dimensions of a carry broadcast against those of the action: a state evaluated under a
thousand candidate actions is computed once.

The recurrence is an explicit `Carry`: `observe` filters on the robot and in replay, `imagine`
advances without an observation. Training computes the same over whole windows
(`egovcp.model.losses.filter_sequence`).
"""

from __future__ import annotations

import copy
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import value
from egovcp.model.config import WorldModelConfig
from egovcp.model.depth import nearness, network_image, to_metres
from egovcp.model.latent_state import Carry, Gaussian
from egovcp.model.networks import (
    DepthDecoder,
    DepthEncoder,
    GruCell,
    SplitLinear,
    SplitMlp,
)
from egovcp.robot_spec import G1, RobotSpec

MIN_STATE_STD: Final = 0.02  # constants, such as the velocity command of a standing robot
MIN_RETURN_QUANTILE: Final = 0.001
#: Typical position and velocity of a task's object and their deviations, heading frame, m and m/s,
#: for the range of the G1's camera; for another range they are scaled with it.
OBJECT_MEAN: Final = (1.5, 0.0, 0.35, -0.5, 0.0, -0.1)
OBJECT_STD: Final = (0.9, 0.25, 0.2, 1.5, 0.5, 1.0)


class PosteriorHead(nn.Module):
    """One hidden layer on [h, o]; o is already projected (`WorldModel.embed_observation`)."""

    def __init__(self, hidden: int, units: int, latent: int) -> None:
        super().__init__()
        self.project_h = nn.Linear(hidden, units, bias=False)
        self.rest = nn.Sequential(nn.LayerNorm(units), nn.SiLU(), nn.Linear(units, 2 * latent))

    def forward(self, h: Tensor, embedding: Tensor) -> Tensor:
        logits: Tensor = self.rest(self.project_h(h) + embedding)
        return logits


class WorldModel(nn.Module):
    """Networks, normalisation and the recurrence; the losses are in `egovcp.model.losses`.

    Args:
        config: sizes of the networks.
        robot: whose observations and actions it models; the shapes in this class are the G1's.
    """

    state_mean: Tensor
    state_std: Tensor
    return_mean: Tensor
    return_std: Tensor
    min_return: Tensor
    discount: Tensor
    object_mean: Tensor
    object_std: Tensor

    def __init__(self, config: WorldModelConfig, robot: RobotSpec = G1) -> None:
        super().__init__()
        self.config = c = config
        self.robot = robot
        state = (c.hidden, c.latent)  # input of every head
        self.encode_depth = DepthEncoder(c.channels, robot.depth)
        self.encode_state = SplitMlp((robot.state_dim,), c.units, c.units)
        self.embed_observation = SplitLinear((self.encode_depth.outputs, c.units), c.units)
        self.mix = SplitLinear((c.latent, robot.action_dim), c.units)
        self.mix_act = nn.Sequential(nn.LayerNorm(c.units), nn.SiLU())
        self.gru = GruCell(c.units, c.hidden, c.update_bias)
        self.posterior = PosteriorHead(c.hidden, c.units, c.latent)
        self.prior = SplitMlp((c.hidden,), c.units, 2 * c.latent)
        self.decode_depth = DepthDecoder(sum(state), c.channels[-1], robot.depth)
        self.decode_state = SplitMlp(state, c.units, robot.state_dim)
        self.termination_head = SplitMlp(state, c.units, 1)
        self.value_head = self._value_head(value.width(c.value_loss))
        self.reward_head = self._value_head(1) if c.loss.reward > 0 else None
        with torch.random.fork_rng(devices=[]):  # the other weights start the same without it
            self.object_head = (
                SplitMlp(state, c.units, len(OBJECT_MEAN)) if c.predicts_object else None
            )
        self._start_at_zero()
        self.register_buffer("state_mean", torch.zeros(robot.state_dim))
        self.register_buffer("state_std", torch.ones(robot.state_dim))
        self.register_buffer("return_mean", torch.zeros(()))
        self.register_buffer("return_std", torch.ones(()))
        self.register_buffer("min_return", torch.zeros(()))
        self.register_buffer("discount", torch.tensor(spec.GAMMA))
        scale = robot.depth_max_m / spec.DEPTH_MAX_M
        self.register_buffer("object_mean", scale * torch.tensor(OBJECT_MEAN), persistent=False)
        self.register_buffer("object_std", scale * torch.tensor(OBJECT_STD), persistent=False)

    def _value_head(self, outputs: int) -> SplitMlp:
        c = self.config
        sizes = (c.hidden, c.latent, self.robot.action_dim)
        return SplitMlp(sizes, c.units, outputs, hidden_layers=2)

    def _start_at_zero(self) -> None:
        """Value and termination heads predict constants before training."""
        self.termination_head.start_at_zero()
        self.value_head.start_at_zero()
        if self.reward_head is not None:
            self.reward_head.start_at_zero()

    def set_statistics(
        self,
        state_mean: NDArray[np.floating],
        state_std: NDArray[np.floating],
        returns: NDArray[np.floating],
        scaled: bool = True,
        gamma: float = spec.GAMMA,
    ) -> None:
        """Set the normalisation constants from a dataset.

        Args:
            state_mean: (74,) mean of the proprioceptive state.
            state_std: (74,) its standard deviation; values below `MIN_STATE_STD` are raised to it.
            returns: (n,) the complete Monte Carlo returns, n >= 1.
            scaled: fit Q to standardised returns; else to the returns themselves.
            gamma: discount per step of the returns.
        """
        values = {
            "state_mean": state_mean,
            "state_std": np.maximum(state_std, MIN_STATE_STD),
            "return_mean": returns.mean(dtype=np.float64) if scaled else 0.0,
            "return_std": max(float(returns.std(dtype=np.float64)), 1e-6) if scaled else 1.0,
            "min_return": np.quantile(returns, MIN_RETURN_QUANTILE),
            "discount": gamma,
        }
        for name, number in values.items():
            getattr(self, name).copy_(torch.as_tensor(number, dtype=torch.float32))

    # --- observation -----------------------------------------------------------------
    def embed_near(self, near: Tensor, standardised: Tensor) -> Tensor:
        """Nearness (B, 48, 64) and standardised state (B, 74) -> embedding (B, units)."""
        image = self.encode_depth(network_image(near))
        embedding: Tensor = self.embed_observation(image, self.encode_state(standardised))
        return embedding

    def standardise(self, state: Tensor) -> Tensor:
        """(..., 74) raw state -> zero mean, unit variance, clipped to +-10."""
        return ((state - self.state_mean) / self.state_std).clamp(-10.0, 10.0)

    # --- recurrence ------------------------------------------------------------------
    def initial(self, batch: int) -> Carry:
        """The carry before the first observation: zeros."""
        reference = self.state_mean
        return Carry(
            reference.new_zeros(batch, self.config.hidden),
            reference.new_zeros(batch, self.config.latent),
        )

    def transition(self, carry: Carry, action: Tensor) -> Tensor:
        """h_{t+1} from (h_t, z_t) and a_t (B, 7); equation 1."""
        x = self.mix_act(self.mix(carry.z, action))
        h: Tensor = self.gru(x, carry.h)
        return h

    def infer(self, h: Tensor, embedding: Tensor) -> Gaussian:
        """Posterior q(z | h, o); equation 2."""
        logits = self.posterior(h, embedding)
        return Gaussian.from_logits(logits, self.config.min_std)

    def predict(self, h: Tensor) -> Gaussian:
        """Prior p(z | h)."""
        return Gaussian.from_logits(self.prior(h), self.config.min_std)

    def observe(
        self,
        carry: Carry,
        action: Tensor,
        depth: Tensor,
        state: Tensor,
        is_first: Tensor,
    ) -> Carry:
        """Filter one observation: a_{t-1} (B, 7) as sent, o_t, is_first (B,) -> carry at t.

        Rows with ``is_first`` start from zeros and the neutral action. z is the
        posterior mean.
        """
        h = self.advance(carry, action, is_first)
        near = nearness(depth, self.config.depth_max_m)
        embedding = self.embed_near(near, self.standardise(state))
        return Carry(h, self.infer(h, embedding).mean)

    def advance(self, carry: Carry, action: Tensor, is_first: Tensor) -> Tensor:
        """h_t of equation 1, restarting from zeros where ``is_first`` (B,).

        The old state is replaced, not multiplied by zero, so that a reset also removes NaN.
        """
        first = is_first[:, None]
        h, z, action = (x.masked_fill(first, 0.0) for x in (carry.h, carry.z, action))
        return self.transition(Carry(h, z), action)

    def imagine(self, carry: Carry, action: Tensor) -> Carry:
        """Advance by one tick without an observation; z is the prior mean."""
        h = self.transition(carry, action)
        return Carry(h, self.predict(h).mean)

    def imagine_sample(
        self, carry: Carry, action: Tensor, generator: torch.Generator | None = None
    ) -> Carry:
        """The same, but z is drawn from the prior, with one noise (latent,) for all rows, so
        that candidates differ by their actions alone."""
        h = self.transition(carry, action)
        prior = self.predict(h)
        size = (self.config.latent,)
        noise = torch.randn(size, generator=generator, device=prior.mean.device)
        return Carry(h, prior.mean + prior.std * noise)

    @staticmethod
    def expand_candidates(carry: Carry) -> Carry:
        """(E, ...) -> (E, 1, ...): one state that broadcasts over candidate actions."""
        return carry.map(lambda x: x[:, None])

    # --- heads -----------------------------------------------------------------------
    def value(self, carry: Carry, action: Tensor, head: SplitMlp | None = None) -> Tensor:
        """Q(h, z, a) in units of return, (...,); equation 5.

        ``head`` is another head than the model's own, such as a target network.
        """
        head = self.value_head if head is None else head
        q = value.read(head(carry.h, carry.z, action), self.config.value_loss)
        return q * self.return_std + self.return_mean

    def value_error(self, carry: Carry, action: Tensor, target: Tensor) -> Tensor:
        """Loss (...,) of Q against a standardised target (...,)."""
        outputs = self.value_head(carry.h, carry.z, action)
        return value.error(outputs, target, self.config.value_loss)

    def reward(self, carry: Carry, action: Tensor) -> Tensor:
        """The reward that a (..., 7) earns at this state, in units of reward, (...,).

        Raises:
            UsageError: the model was trained without ``loss.reward``.
        """
        return self.scaled_reward(carry, action) * self.return_std

    def scaled_reward(self, carry: Carry, action: Tensor) -> Tensor:
        """The same in units of the return's deviation; zero stays zero."""
        if self.reward_head is None:
            raise UsageError(
                "this world model predicts no rewards; train it with --policy.loss.reward=1"
            )
        r: Tensor = self.reward_head(carry.h, carry.z, action)
        return r.squeeze(-1).float()

    def standardised_object(self, carry: Carry) -> Tensor:
        """Standardised position and velocity of the task's object, (..., 6).

        Raises:
            UsageError: the model has no decoder of it, as a saved policy.
        """
        if self.object_head is None:
            raise UsageError(
                "this world model does not decode the object's position; only models in training "
                "with loss.object or loss.multistep_object do"
            )
        state: Tensor = self.object_head(carry.h, carry.z)
        return state.float()

    def standardise_object(self, state: Tensor) -> Tensor:
        """Position and velocity (..., 6), m and m/s -> typical values 0, deviations 1, clipped."""
        return ((state - self.object_mean) / self.object_std).clamp(-5.0, 5.0)

    def object_position(self, carry: Carry) -> Tensor:
        """Position of the task's object in the heading frame, m, (..., 3)."""
        state = self.standardised_object(carry) * self.object_std + self.object_mean
        return state[..., :3]

    def without_object_head(self) -> WorldModel:
        """A copy without the decoder of the object's position, which only training uses."""
        model = copy.deepcopy(self)
        model.object_head = None
        model.config = self.config.without_object()
        return model

    def termination_logit(self, carry: Carry) -> Tensor:
        """Logit of the probability that the episode has failed here, (...,); equation 4."""
        d: Tensor = self.termination_head(carry.h, carry.z)
        return d.squeeze(-1).float()

    def termination(self, carry: Carry) -> Tensor:
        """Probability that the episode has failed at this state, (...,)."""
        return torch.sigmoid(self.termination_logit(carry))

    def decode_near(self, carry: Carry) -> Tensor:
        """Decoded nearness (B, 48, 64) of a state (B, ...); not clamped."""
        image: Tensor = self.decode_depth(carry.features)
        return image.float()

    def decode(self, carry: Carry) -> tuple[Tensor, Tensor]:
        """Carry (B, ...) -> depth (B, 48, 64) in metres, 0 = nothing in range; state (B, 74)."""
        depth = to_metres(self.decode_near(carry), self.config.depth_max_m)
        return depth, self.decode_state(carry.h, carry.z).float() * self.state_std + self.state_mean
