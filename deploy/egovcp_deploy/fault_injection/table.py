"""Runs faults and sums up what came of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from egovcp_deploy.fault_injection.kinds import FaultKind, Reaction
from egovcp_deploy.fault_injection.rig import FaultRig, Observed
from egovcp_deploy.pilot.states import State

DAMP_LIMIT_MS: Final = 250.0
_DAMPS: Final = (Reaction.DAMP, Reaction.LATER)
_PATIENCE_S: Final = 1.5  # for a damping that must come
_RECOVERY_S: Final = 5.0


@dataclass(frozen=True)
class FaultRun:
    """What came of one fault, once."""

    kind: FaultKind
    end: str
    """State at the end: of the fault if it damps, else after it."""
    held_ms: float | None
    """To the first report from HOLD, a multiple of 40 ms."""
    damped_ms: float | None
    """To the first command that damps."""
    greatest_change: float
    """rad, between the targets of two ticks."""
    unsound: int
    """Commands that were not finite, or beyond the bounds of the joints' targets."""
    reason: str
    """Of the change to the worst state."""

    @property
    def problem(self) -> str:
        """Why this is not what must come of the fault; empty: it is."""
        if self.unsound:
            return f"{self.unsound} commands were not sound"
        reaction = self.kind.reaction
        if reaction in _DAMPS:
            damped = self.damped_ms is not None
            return self._wrong_reason if damped else f"was not damped, but {self.end}"
        if reaction is Reaction.ANY:
            return ""
        if self.damped_ms is not None:
            return f"was damped: {self.reason}"
        if self.end != State.RUN:
            return f"did not return to run, but is in {self.end}: {self.reason}"
        if reaction is Reaction.HOLD and self.held_ms is None:
            return "was not held"
        if reaction is Reaction.RUN and "proprioception" in self.reason:
            return f"was held: {self.reason}"
        return self._wrong_reason

    @property
    def _wrong_reason(self) -> str:
        """A report can be lost when the process ends: no reason is not a wrong one."""
        if not self.reason or self.kind.reason in self.reason:
            return ""
        return f"the reason is not {self.kind.reason!r}, but {self.reason!r}"


def run_fault(rig: FaultRig, kind: FaultKind) -> FaultRun:
    """Bring ``rig`` to RUN, let the fault happen, and end it."""
    rig.ensure_running()
    begin = time.monotonic()
    must_damp = kind.reaction in _DAMPS
    limit = begin + max(kind.duration_s, _PATIENCE_S if must_damp else 0.0)

    def over(observed: Observed) -> bool:
        return observed.damped_ns is not None or time.monotonic() > limit

    observed = rig.observe(lambda: kind.begin(rig), over)
    damped = observed.damped_ns is not None
    if damped:
        end = str(State.DAMP)
    else:
        rig.heal()
        deadline = time.monotonic() + _RECOVERY_S
        while not rig.running and time.monotonic() < deadline:
            time.sleep(0.01)
        end = rig.mode or "silent"
    reference = observed.onset_ns if kind.since_onset else observed.last_good_ns
    row = FaultRun(
        kind,
        end,
        _ms(observed.held_ns, reference),
        _ms(observed.damped_ns, reference),
        observed.greatest_change,
        sum(not command.sound for command in observed.commands),
        _reason(observed, kind.reason),
    )
    if damped or end != State.RUN:
        rig.end_run()
    return row


def _ms(time_ns: int | None, since_ns: int) -> float | None:
    return None if time_ns is None else (time_ns - since_ns) / 1e6


def _reason(observed: Observed, expected: str) -> str:
    """Of the change to the worst state; of several, the first that contains ``expected``."""
    changes = [event.partition(": ") for event in observed.events if " -> " in event]
    for state in (State.DAMP, State.HOLD):
        reasons = [reason for change, _, reason in changes if change.endswith(f"-> {state}")]
        if reasons:
            return next((reason for reason in reasons if expected in reason), reasons[0])
    return ""


def percentile(values: Sequence[float | None], q: float) -> float | None:
    """Of the numbers among ``values``; None: there are none."""
    numbers = [value for value in values if value is not None]
    return float(np.percentile(numbers, q)) if numbers else None


def markdown(rows: Sequence[FaultRun]) -> str:
    """A table, one line per kind of fault."""
    lines = [
        "| fault | end state | HOLD, ms | DAMP, ms (median, p99) | greatest change, rad |",
        "|---|---|---|---|---|",
    ]
    kinds = list(dict.fromkeys(row.kind for row in rows))
    for kind in kinds:
        same = [row for row in rows if row.kind is kind]
        ends = sorted({row.end for row in same})
        held = percentile([row.held_ms for row in same], 50)
        damped = [row.damped_ms for row in same]
        both = [percentile(damped, q) for q in (50, 99)]
        change = max(row.greatest_change for row in same)
        shown = "" if both[0] is None else ", ".join(f"{v:.0f}" for v in both if v is not None)
        hold = "" if held is None else f"{held:.0f}"
        lines.append(f"| {kind.name} | {', '.join(ends)} | {hold} | {shown} | {change:.3f} |")
    return "\n".join(lines) + "\n"
