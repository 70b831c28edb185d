"""The ego-vision world model (paper section III-C).

    h_t = f(h_{t-1}, z_{t-1}, a_{t-1})        (1)   deterministic state, GRU
    z_t ~ q(z | h_t, o_t)                     (2)   posterior, from depth and proprioception
    o_t ~ p(o | h_t, z_t)                     (3)   decoder
    z^_t ~ p(z | h_t)                               prior, without the observation
    d_t = D(h_t, z_t)                         (4)   probability of termination
    Q_t = Q(h_t, z_t, a_t)                    (5)   surrogate value

Every method accepts a carry whose leading dimensions broadcast against the action's: one
state judged under a thousand candidates is computed once.

The recurrence is an explicit `Carry`: the same `observe` step serves training, filtering
on the robot and replay; `imagine` advances it without an observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import flight, value
from egovcp.model.camera_pose import CameraPose, camera_pose
from egovcp.model.carry import Carry
from egovcp.model.config import WorldModelConfig
from egovcp.model.depth import nearness, network_image, paint_ball, to_metres
from egovcp.model.floor import Floor, floor
from egovcp.model.gaussian import Gaussian
from egovcp.model.nets import (
    DepthDecoder,
    DepthEncoder,
    GruCell,
    SplitLinear,
    SplitMlp,
    ValueHead,
)

#: The head's units of y, z (m) and of the time left (s): about their spread.
PASSING_UNIT = (0.25, 0.25, 0.25)


class PosteriorHead(nn.Module):
    """One hidden layer on [h, o]; the part of o arrives ready-made (`embed_observation`)."""

    def __init__(self, hidden: int, units: int, latent: int) -> None:
        super().__init__()
        self.project_h = nn.Linear(hidden, units, bias=False)
        self.rest = nn.Sequential(nn.LayerNorm(units), nn.SiLU(), nn.Linear(units, 2 * latent))

    def forward(self, h: Tensor, embedding: Tensor) -> Tensor:
        logits: Tensor = self.rest(self.project_h(h) + embedding)
        return logits


class Look(NamedTuple):
    """What N pictures show of a flight, and from where."""

    sighting: flight.Sighting
    pose: CameraPose
    floor: Floor


def _later(carry: Carry) -> Tensor | None:
    return None if carry.flight is None else flight.later(carry.flight)


class QHeads(NamedTuple):
    """The heads of Q: each answers with the sum of a part of its own and one that all share."""

    states: tuple[ValueHead, ...]
    """Each reads (h, z) and the action."""
    passing: SplitMlp | None
    """Reads what is on its way and the action: few numbers, of which there are no two views."""

    @property
    def parts(self) -> tuple[ValueHead | SplitMlp, ...]:
        """All of them, the shared one last."""
        return (*self.states, *(() if self.passing is None else (self.passing,)))


def _fill_discount(model: WorldModel, state: dict[str, Any], prefix: str, *unused: object) -> None:
    """Weights that were saved before the discount was kept with them leave it as it is."""
    state.setdefault(f"{prefix}discount", model.discount)


class WorldModel(nn.Module):
    """Networks, normalisation and the recurrence; the losses are in `egovcp.model.losses`."""

    state_mean: Tensor
    state_std: Tensor
    return_mean: Tensor
    return_std: Tensor
    return_floor: Tensor
    discount: Tensor

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        self.config = c = config
        state = (c.hidden, c.latent)  # what every head reads
        self.encode_depth = DepthEncoder(c.channels)
        self.encode_state = SplitMlp((spec.STATE_DIM,), c.units, c.units)
        self.embed_observation = SplitLinear((self.encode_depth.outputs, c.units), c.units)
        self.mix = SplitLinear((c.latent, spec.ACTION_DIM), c.units)
        self.mix_act = nn.Sequential(nn.LayerNorm(c.units), nn.SiLU())
        self.gru = GruCell(c.units, c.hidden, c.update_bias)
        self.posterior = PosteriorHead(c.hidden, c.units, c.latent)
        self.prior = SplitMlp((c.hidden,), c.units, 2 * c.latent)
        self.decode_depth = DepthDecoder(sum(state), c.channels[-1])
        self.decode_state = SplitMlp(state, c.units, spec.STATE_DIM)
        self.decode_motion = SplitMlp(state, c.units, 4 * len(c.motion_ahead))
        self.decode_sight = nn.Sequential(nn.LayerNorm(c.units), nn.SiLU(), nn.Linear(c.units, 4))
        self.decode_passing = SplitMlp(state, c.units, 4)
        self.termination_head = SplitMlp(state, c.units, 1)
        self.value_head = self._new_value_head()
        self.passing_value_head = self._new_passing_value_head() if c.value_of_passing else None
        more = (self._new_value_head() for _ in range(c.q_heads - 1))
        self.more_value_heads = nn.ModuleList(more)
        self.reward_head = ValueHead(state, c.value_state, c.units) if c.loss.reward > 0 else None
        self._start_at_zero()
        self.register_buffer("state_mean", torch.zeros(spec.STATE_DIM))
        self.register_buffer("state_std", torch.ones(spec.STATE_DIM))
        self.register_buffer("return_mean", torch.zeros(()))
        self.register_buffer("return_std", torch.ones(()))
        self.register_buffer("return_floor", torch.zeros(()))
        self.register_buffer("discount", torch.tensor(spec.GAMMA))
        self.register_load_state_dict_pre_hook(_fill_discount)  # type: ignore[no-untyped-call]

    def _new_value_head(self) -> ValueHead:
        c = self.config
        outputs = value.width(c.value_loss)
        return ValueHead((c.hidden, c.latent), c.value_state, c.value_units or c.units, outputs)

    def _new_passing_value_head(self) -> SplitMlp:
        c = self.config
        units, outputs = (c.value_units or c.units) // 2, value.width(c.value_loss)
        return SplitMlp((4, spec.ACTION_DIM), units, outputs, hidden_layers=2)

    def _start_at_zero(self) -> None:
        """Value and termination start as constants, so that early plans are not random."""
        self.termination_head.start_at_zero()
        for head in (*self.q_heads.parts, self.reward_head):
            if head is not None:
                head.start_at_zero()

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
            reference.new_zeros(batch, flight.SIZE) if self.config.follows_flight else None,
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
        near = nearness(depth, self.config.depth_max_m)
        return self.observe_near(carry, action, near, state, is_first)

    def observe_near(
        self, carry: Carry, action: Tensor, near: Tensor, state: Tensor, is_first: Tensor
    ) -> Carry:
        """The same from nearness (B, 48, 64)."""
        h = self.advance(carry, action, is_first)
        embedding = self.embed_near(near, self.standardise(state))
        z, followed = self.infer(h, embedding).mean, carry.flight
        if followed is not None:
            seen = self.look(near, state, embedding)
            followed = self.follow(followed, seen, is_first)
        return Carry(h, z, followed)

    @torch.no_grad()
    def look(self, near: Tensor, state: Tensor, embedding: Tensor) -> Look:
        """What pictures (N, 48, 64) of nearness show of a flight, and from where: raw state (N, 74)
        and the embedding (N, units) of both."""
        c = self.config
        seen = flight.sighting(near, self.sight(embedding), c.depth_max_m, c.flight)
        pose = camera_pose(state, c.flight.camera)
        return Look(seen, pose, floor(near, pose, c.depth_max_m, c.flight.camera))

    @torch.no_grad()
    def follow(self, memory: Tensor, seen: Look, is_first: Tensor) -> Tensor:
        """What is remembered of a flight (N, ...) after N pictures."""
        return flight.follow(
            memory, seen.pose, seen.sighting, seen.floor, is_first, self.config.flight
        )

    @torch.no_grad()
    def follow_all(self, memory: Tensor, seen: Look, is_first: Tensor) -> Tensor:
        """The same after each of T ticks, (N, T, ...): memory (N, ...) before, all else (N, T)."""
        return flight.follow_all(
            memory, seen.pose, seen.sighting, seen.floor, is_first, self.config.flight
        )

    def advance(self, carry: Carry, action: Tensor, is_first: Tensor) -> Tensor:
        """h_t of equation 1, restarting from zeros where ``is_first`` (B,).

        The old memory is replaced, not multiplied by zero: a reset heals NaN, too.
        """
        first = is_first[:, None]
        h, z, action = (x.masked_fill(first, 0.0) for x in (carry.h, carry.z, action))
        return self.transition(Carry(h, z), action)

    def imagine(self, carry: Carry, action: Tensor) -> Carry:
        """Advance by one tick without an observation; z is the prior mean."""
        h = self.transition(carry, action)
        return Carry(h, self.predict(h).mean, _later(carry))

    def imagine_sample(
        self, carry: Carry, action: Tensor, generator: torch.Generator | None = None
    ) -> Carry:
        """The same, but z is drawn from the prior, with one noise (latent,) for all rows: what
        differs between two candidates is what they do, not their luck."""
        h = self.transition(carry, action)
        prior = self.predict(h)
        size = (self.config.latent,)
        noise = torch.randn(size, generator=generator, device=prior.mean.device)
        return Carry(h, prior.mean + prior.std * noise, _later(carry))

    @staticmethod
    def spread(carry: Carry) -> Carry:
        """(E, ...) -> (E, 1, ...): one state that broadcasts over candidate actions."""
        return carry.map(lambda x: x[:, None])

    # --- heads -----------------------------------------------------------------------
    def value(self, carry: Carry, action: Tensor) -> Tensor:
        """Q(h, z, a) in units of return, (...,); equation 5."""
        return self.standardised_value(carry, action) * self.return_std + self.return_mean

    def value_by(self, heads: QHeads, carry: Carry, action: Tensor) -> Tensor:
        """The same by other heads than the model's own."""
        q = self._read_values(self._value_outputs(carry, action, heads)).mean(0)
        return q * self.return_std + self.return_mean

    def standardised_value(self, carry: Carry, action: Tensor) -> Tensor:
        """Q in units of the return's deviation from its mean, (...,).

        The sum of what an action is worth in view of what is on its way, and of what the rest
        of the state adds. The first part sees little else than the action: a regression on
        the whole state predicts the return better and ranks actions worse (`docs/log.md`).
        """
        return self._all_values(carry, action).mean(0)

    def lowest_value(self, carry: Carry, action: Tensor) -> Tensor:
        """What the most doubtful of the heads of Q says, in units of return, (...,)."""
        q = self._all_values(carry, action).amin(0)
        return q * self.return_std + self.return_mean

    def value_error(self, carry: Carry, action: Tensor, target: Tensor) -> Tensor:
        """Loss of Q beside the standardised return (...,), mean over the heads, (...,)."""
        kind = self.config.value_loss
        outputs = self._value_outputs(carry, action, self.q_heads)
        return torch.stack([value.error(q, target, kind) for q in outputs]).mean(0)

    @property
    def q_heads(self) -> QHeads:
        """The heads of Q."""
        more: list[ValueHead] = list(self.more_value_heads)  # type: ignore[arg-type]
        return QHeads((self.value_head, *more), self.passing_value_head)

    def _all_values(self, carry: Carry, action: Tensor) -> Tensor:
        """Of each head, in units of the return's deviation from its mean, (heads, ...)."""
        return self._read_values(self._value_outputs(carry, action, self.q_heads))

    def _read_values(self, outputs: Sequence[Tensor]) -> Tensor:
        return torch.stack([value.read(q, self.config.value_loss) for q in outputs])

    def _value_outputs(self, carry: Carry, action: Tensor, heads: QHeads) -> list[Tensor]:
        """Of each head, (..., width of `egovcp.model.value`)."""
        outputs = [head(carry.h, carry.z, action) for head in heads.states]
        if heads.passing is None:
            return outputs
        shared = heads.passing(self.passing(carry), action)
        return [q + shared for q in outputs]

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

    def passing(self, carry: Carry) -> Tensor:
        """Is something on its way, and if so where and when will it pass, (..., 4).

        Where a flight is followed: how sure its path is, y, z and time left in
        `PASSING_UNIT`, zeros without one. Else the probability p that something comes, and p times
        these: a smooth summary that is zero where nothing does.
        """
        if carry.flight is not None:
            return flight.told(carry.flight, PASSING_UNIT)
        out: Tensor = self.decode_passing(carry.h, carry.z)
        out = out.detach()  # what is on its way is learned from labels, not from returns
        coming = torch.sigmoid(out[..., 3:])
        return torch.cat([coming, coming * out[..., :3]], -1)

    def termination_logit(self, carry: Carry) -> Tensor:
        """Log-odds that the episode has failed at this state, (...,); equation 4."""
        d: Tensor = self.termination_head(carry.h, carry.z)
        return d.squeeze(-1).float()

    def termination(self, carry: Carry) -> Tensor:
        """Probability that the episode has failed at this state, (...,)."""
        return torch.sigmoid(self.termination_logit(carry))

    def motion(self, carry: Carry) -> Tensor:
        """Where in the picture something flies, ``motion_ahead`` ticks ahead, (..., A, 4): column
        and row of its middle in half pictures from the middle, nearness, log-odds that it does."""
        out: Tensor = self.decode_motion(carry.h, carry.z).float()
        return out.view(*out.shape[:-1], len(self.config.motion_ahead), 4)

    def sight(self, embedding: Tensor) -> Tensor:
        """What `motion` says of now, (..., 4), from one observation's embedding (..., units)."""
        out: Tensor = self.decode_sight(embedding).float()
        return out

    def picture(self, carry: Carry) -> Tensor:
        """Nearness (B, 48, 64) of the picture at a state (B, ...); not clamped.

        What flies is painted as a ball where `motion` says that it is: a network that paints
        every pixel by itself learns late, and never sharply, to move ten of them.
        """
        image: Tensor = self.decode_depth(carry.features).float()
        if not self.config.paint_flight:
            return image
        return paint_ball(image, self._place(carry), self.config.depth_max_m)

    def _place(self, carry: Carry) -> Tensor:
        """Where what flies is painted, (B, 4) as `motion`."""
        place = self.motion(carry)[..., 0, :]
        if carry.flight is None or carry.flight.shape[-1] < flight.SIZE:
            return place
        c = self.config
        state = self.decode_state(carry.h, carry.z).float() * self.state_std + self.state_mean
        followed = flight.in_picture(carry.flight, state, c.depth_max_m, c.flight)
        return torch.where(followed[:, 3:] > 0, followed, place)

    def decode(self, carry: Carry) -> tuple[Tensor, Tensor]:
        """Carry (B, ...) -> depth (B, 48, 64) in metres, 0 = nothing in range; state (B, 74)."""
        depth = to_metres(self.picture(carry), self.config.depth_max_m)
        return depth, self.decode_state(carry.h, carry.z).float() * self.state_std + self.state_mean
