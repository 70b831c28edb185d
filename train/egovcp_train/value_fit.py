"""The last touch: fit Q alone, on states filtered once from the whole dataset.

While encoder and recurrence are still moving, the value head sees each row a few times
and always in a new guise. With the states held fixed a pass over all rows costs a second,
so that the head can be fitted to the end: on a trial of 3840 throws the variance that Q
explains on held-out episodes doubled (0.04 to 0.08).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from egovcp.bounds import bounded, check_bounds
from egovcp.model import Batch, Carry, WorldModel, value
from egovcp.model.losses import filter_sequence
from egovcp.model.nets import SplitMlp, ValueHead
from egovcp.model.outcomes import value_target

ToldWhere = Literal["everywhere", "coming"]
Mirrored = Literal["all", "flights", "none"]

_COMING: Final = 0.01
"""How sure the path of a flight has to be to count as one; zero where none is followed."""


@dataclass(frozen=True)
class ValueFitConfig:
    """Fit of the value head on fixed states at the end of training."""

    steps: int = bounded(600, least=0)
    """Least gradient steps of the part of Q that reads the state, and of the reward; 0: no fit."""
    passes: float = bounded(8.0, least=0)
    """How often all rows are gone over at least: of many, the least steps would see a part only,
    and after two passes another seed is another policy."""
    mirror: Mirrored = "all"
    """Whose mirror images the fit goes over as well, if windows are mirrored (--sampling.mirror).
    flights: those of episodes in which something flies, whose rows are few beside others' where
    tasks are mixed."""
    imagined_steps: int = bounded(3, least=0, most=1000)
    """States are imagined 0 to this many ticks ahead, as far as the planner looks."""
    rows: int = bounded(1024, least=1, most=1_000_000)
    """States per step."""
    lr: float = bounded(1e-3, above=0)
    """Peak learning rate; one cycle."""
    told_steps: int = bounded(2500, least=0)
    """Gradient steps of the part of Q that reads what is told of a flight: few numbers, from which
    there is more to be learned than from the state, which is soon known by heart (docs/log.md).
    0: the part stays silent. Where nothing flies it judges an action by what followed on actions
    like it in all states; on the wall the other part is better off without."""
    told_where: ToldWhere = "everywhere"
    """Rows that that part judges. coming: those on which something is on its way, and elsewhere it
    learns to say nothing: where tasks are mixed, what followed on actions like one in all states
    of all tasks misleads the wall."""
    told_rows: int = bounded(2048, least=1, most=1_000_000)
    """States per step of that part."""
    told_lr: float = bounded(2e-3, above=0)
    """Peak learning rate of that part."""
    weight_decay: float = bounded(0.1, least=0)
    """Decoupled weight decay."""
    dropout: float = bounded(0.5, least=0, below=1)
    """Share of h and z hidden from the head at each step: a few thousand throws are soon known by
    heart."""

    def __post_init__(self) -> None:
        check_bounds(self)

    def steps_over(self, rows: int) -> int:
        """Gradient steps of the part that reads the state, where there are so many rows."""
        return max(self.steps, math.ceil(self.passes * rows / self.rows))


class Rows(NamedTuple):
    """States and what they were worth."""

    h: Tensor  # (R, hidden)
    z: Tensor  # (R, latent)
    told: Tensor  # (R, 4) what is on its way
    action: Tensor  # (R, 7)
    target: Tensor  # (R,) of Q, standardised
    reward: Tensor  # (R,) in deviations of the return


def fit_value(
    model: WorldModel, episodes: Iterable[Batch], config: ValueFitConfig, seed: int
) -> None:
    """Fit the heads of Q in place, from scratch, to their target on the rows of whole episodes.

    Under ``q_target=td`` the targets are what the Q that training has found says of the next
    rows: one more round of fitted Q evaluation.

    First the part that sees only what is on its way, then the part that sees the whole state, to
    what the first leaves unexplained. Fitted together, the second, which sees where the hands are
    going anyway, takes over what belongs to the action.

    Args:
        model: the finished world model.
        episodes: batches of whole episodes from their start.
        config: the fit.
        seed: of the heads' start, of the sampled rows and of how far each state is imagined.
    """
    if config.steps == 0:
        return
    generator = torch.Generator().manual_seed(seed)
    rows = collect_rows(model, episodes, config.imagined_steps, generator)
    device = model.state_mean.device
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        _fit_heads(model, rows, config, generator)


def _fit_heads(
    model: WorldModel, rows: Rows, config: ValueFitConfig, generator: torch.Generator
) -> None:
    """Each head of Q, and that of the reward if there is one."""
    known = _fit_told(model, rows, config, generator)
    config = replace(config, steps=config.steps_over(len(rows.target)))
    for head in model.q_heads.states:
        _fit_state(model, head, rows, known, config, generator)
    if (reward := model.reward_head) is not None:

        def earned(x: Rows, known: Tensor | None) -> Tensor:
            r: Tensor = reward(*_hidden(x, config), x.action)
            return (r.squeeze(-1) - x.reward).square().mean()

        _descend(reward, earned, rows, None, config, generator)


def _fit_told(
    model: WorldModel, rows: Rows, config: ValueFitConfig, generator: torch.Generator
) -> Tensor | None:
    """The part of Q that is told of a flight.

    Returns:
        What it says of all rows, (R, outputs); None if it says nothing.
    """
    kind, passing = model.config.value_loss, model.q_heads.passing
    if passing is None:
        return None
    if config.told_steps == 0:
        passing.restart()
        return None

    def told(x: Rows) -> Tensor:
        q: Tensor = passing(x.told, x.action)
        return q

    def told_error(x: Rows, known: Tensor | None) -> Tensor:
        said = told(x)
        error = value.error(said, x.target, kind)
        if config.told_where == "coming":
            error = torch.where(x.told[:, 0] > _COMING, error, said.square().mean(-1))
        return error.mean()

    thorough = replace(config, steps=config.told_steps, rows=config.told_rows, lr=config.told_lr)
    _descend(passing, told_error, rows, None, thorough, generator)
    with torch.no_grad():
        chunks = torch.split(torch.arange(len(rows.target)), 65536)
        return torch.cat([told(_pick(rows, some)) for some in chunks])


def _fit_state(
    model: WorldModel,
    head: ValueHead,
    rows: Rows,
    known: Tensor | None,
    config: ValueFitConfig,
    generator: torch.Generator,
) -> None:
    """A part of Q that reads the state, to what is ``known`` leaves unexplained."""
    kind = model.config.value_loss

    def judged(x: Rows, known: Tensor | None) -> Tensor:
        q: Tensor = head(*_hidden(x, config), x.action)
        if known is None:
            return value.error(q, x.target, kind).mean()
        return value.error_beyond(q, known, x.target, kind).mean()

    _descend(head, judged, rows, known, config, generator)


def _hidden(x: Rows, config: ValueFitConfig) -> tuple[Tensor, Tensor]:
    """h and z, some of them hidden."""
    return F.dropout(x.h, config.dropout), F.dropout(x.z, config.dropout)


def _descend(
    head: SplitMlp | ValueHead,
    loss: Callable[[Rows, Tensor | None], Tensor],
    rows: Rows,
    known: Tensor | None,
    config: ValueFitConfig,
    generator: torch.Generator,
) -> None:
    """Fit ``head`` from scratch to a small ``loss`` of rows and of what is ``known`` of them."""
    head.restart()
    head.requires_grad_(True)
    optimizer = torch.optim.AdamW(head.parameters(), lr=config.lr, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.lr, total_steps=config.steps)
    for _ in tqdm(range(config.steps), unit="step", desc="fit Q", mininterval=1.0, leave=False):
        pick = torch.randint(len(rows.target), (config.rows,), generator=generator)
        optimizer.zero_grad(set_to_none=True)
        beyond = None if known is None else known[pick.to(known.device)]
        loss(_pick(rows, pick), beyond).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    head.requires_grad_(False)


def _pick(rows: Rows, which: Tensor) -> Rows:
    which = which.to(rows.target.device)
    return Rows(*(x[which].float() for x in rows))


@torch.no_grad()
def collect_rows(
    model: WorldModel,
    episodes: Iterable[Batch],
    imagined_steps: int,
    generator: torch.Generator,
) -> Rows:
    """Every row whose target is known, as the planner would meet it; where the model is.

    The planner judges filtered states (k = 0) and states imagined k < N steps ahead, so
    each row is reached by a k drawn from 0 .. ``imagined_steps``.
    """
    parts = [_rows_of(model, batch, imagined_steps, generator) for batch in episodes]
    return Rows(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _rows_of(
    model: WorldModel, batch: Batch, imagined_steps: int, generator: torch.Generator
) -> Rows:
    """States of one batch of episodes, each imagined a random number of steps ahead."""
    carry = filter_sequence(model, batch, sample=False).carry
    target, usable = value_target(model, carry, batch)
    reward = batch.reward / model.return_std
    length = batch.valid.shape[1]
    depth = min(imagined_steps, length - 1)
    steps = torch.randint(depth + 1, usable.shape, generator=generator).to(usable.device)
    found: list[tuple[Tensor, ...]] = []
    for k in range(depth + 1):
        if k > 0:
            carry = model.imagine(_before(carry, length - k), batch.action[:, k - 1 : length - 1])
        mask = usable[:, k:] & (steps[:, k:] == k)
        ahead = (x[:, k:][mask] for x in (batch.action, target, reward))
        told = model.passing(carry)
        found.append((carry.h[mask], carry.z[mask], told[mask], *ahead))
    columns = (torch.cat(column) for column in zip(*found, strict=True))
    h, z, told, action, *targets = columns
    return Rows(h.half(), z.half(), told, action.half(), *targets)


def _before(carry: Carry, rows: int) -> Carry:
    return carry.map(lambda x: x[:, :rows])
