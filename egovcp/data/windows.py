"""Windows of rows as arrays ``[B, T, ...]``, and their reflections."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp.data.mirror import mirror_action, mirror_depth, mirror_state
from egovcp.data.store import EpisodeStore

type Batch = dict[str, NDArray[Any]]


def gather(
    store: EpisodeStore, start: NDArray[np.int64], episode: NDArray[np.int64], span: int
) -> Batch:
    """Windows of ``span`` rows, each from one episode, as arrays ``[B, span, ...]``.

    Keys: depth (uint16 mm), state, action, prev_action, reward, done, success, is_first,
    valid, mc_return, mc_valid, terminal_next; episode [B] and t [B, span] for reports.
    Past the episode's end the last row is repeated with ``valid``, ``mc_valid`` and the
    flags false.
    """
    end = store.start[episode] + store.length[episode]
    wanted = start[:, None] + np.arange(span)
    valid = wanted < end[:, None]
    rows = np.minimum(wanted, end[:, None] - 1)
    t = rows - store.start[episode][:, None]
    batch: Batch = {
        name: getattr(store, name)[rows]
        for name in ("depth", "state", "action", "prev_action", "reward", "mc_return")
    }
    for name in ("done", "success", "terminal_next", "mc_valid"):
        batch[name] = getattr(store, name)[rows] & valid
    batch |= {"is_first": (t == 0) & valid, "valid": valid, "episode": episode, "t": t}
    return batch


def mirror_rows(batch: Batch, rows: NDArray[np.intp]) -> None:
    """Reflect the windows ``rows`` of a batch left to right, in place."""
    batch["depth"][rows] = mirror_depth(batch["depth"][rows])
    batch["state"][rows] = mirror_state(batch["state"][rows])
    for name in ("action", "prev_action"):
        batch[name][rows] = mirror_action(batch[name][rows])


def draw_mirrored(count: int, mirror: bool, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(count,) which windows to reflect: half of them; none, and no draw, unless ``mirror``."""
    return rng.random(count) < 0.5 if mirror else np.zeros(count, dtype=np.bool_)


def finish(batch: Batch, burn_in: int, mirrored: NDArray[np.bool_]) -> Batch:
    """Mark the rows that only warm up, and reflect the windows ``mirrored`` (B,), in place."""
    span = batch["t"].shape[1]
    batch["valid"] &= ~((np.arange(span) < burn_in) & (batch["t"][:, :1] > 0))
    mirror_rows(batch, np.flatnonzero(mirrored))
    return batch
