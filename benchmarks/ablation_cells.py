"""The cells of `ablations.py`: a name and the one choice in which it differs from the default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from egovcp import spec

_PIXELS: Final = spec.DEPTH_ROWS * spec.DEPTH_COLS

#: Flags of egovcp-train.
TRAINING: Final[Mapping[str, tuple[str, ...]]] = {
    "default": (),
    "paper": ("--preset=paper",),
    "kl_equal": ("--policy.loss.kl_posterior=0.1",),
    "kl_tenfold": ("--policy.loss.kl_prior=1", "--policy.loss.kl_posterior=0.1"),
    "no_free_nats": ("--policy.loss.free_nats=0",),
    "free_nats_per_dimension": ("--policy.loss.free_nats_per=dimension",),
    "pixels_summed": (f"--policy.loss.depth={_PIXELS}",),
    "state_summed": (f"--policy.loss.state={spec.STATE_DIM}",),
    "state_1": ("--policy.loss.state=1", "--policy.loss.foresight_state=1"),
    "no_moving": ("--policy.loss.moving=0",),
    "no_flight": ("--policy.loss.flight=0",),
    "no_foresight": ("--policy.loss.foresight_depth=0", "--policy.loss.foresight_state=0"),
    "near": ("--policy.loss.near=10",),
    "no_paint_flight": ("--policy.paint_flight=false",),
    "no_motion": ("--policy.paint_flight=false", "--policy.loss.motion=0"),
    "raw_returns": ("--returns.scale=none",),
    "two_hot": ("--policy.value_loss=two_hot",),
    "five_q_heads": ("--policy.q_heads=5",),
    "q_of_posterior_only": ("--policy.loss.imagined_steps=0",),
    "reward_head": ("--policy.loss.reward=1",),
    "arwm": ("--policy.dynamics=autoregressive",),
    "td": ("--policy.loss.q_target=td",),
    "burn_in": ("--sampling.burn_in=8",),
    "long_windows": ("--sampling.length=40", "--batch_size=8"),  # as many rows per step
    "per_task_returns": ("--returns.scale=per_task",),
}

#: Flags of egovcp-eval, which change how one artefact is used.
PLANNER: Final[Mapping[str, tuple[str, ...]]] = {
    "default": (),
    "rule_paper": ("--planner.termination_rule=paper",),
    "rule_shift": ("--planner.termination_rule=shift",),
    "rule_survival": ("--planner.termination_rule=survival",),
    "latent_sample": ("--planner.latent=sample",),
    "ensemble_min": ("--planner.ensemble=min",),
}

SETS: Final = {"training": TRAINING, "planner": PLANNER}
