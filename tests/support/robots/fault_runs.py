"""Runs faults and evaluates the reactions."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from egovcp_deploy.pilot.states import State

from .fault_kinds import FaultKind, Reaction
from .fault_rig import FaultRig, Observed

DAMP_LIMIT_MS: Final = 250.0
_DAMPS: Final = (Reaction.DAMP, Reaction.LATER)
_DAMP_TIMEOUT_S: Final = 1.5
_RECOVERY_S: Final = 5.0


@dataclass(frozen=True)
class FaultRun:
    """Reaction to one fault."""

    kind: FaultKind
    end: str
    """Final state: of the fault if the robot is damped, else after it."""
    held_ms: float | None
    """Time to the first report from HOLD, a multiple of 40 ms."""
    damped_ms: float | None
    """Time to the first damping command."""
    max_change: float
    """Largest change of a target between two ticks, rad."""
    invalid: int
    """Commands that were not finite, or out of the bounds of the joints' targets."""
    reason: str
    """Reported reason of the change to the worst state."""

    @property
    def problem(self) -> str:
        """Why this is not the required reaction; empty: it is."""
        if self.invalid:
            return f"{self.invalid} invalid commands"
        reaction = self.kind.reaction
        if reaction in _DAMPS:
            damped = self.damped_ms is not None
            return self._wrong_reason if damped else f"was not damped, but is in {self.end}"
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
        """A report can be lost when the process ends, so a missing reason is accepted."""
        if not self.reason or self.kind.reason in self.reason:
            return ""
        return f"the reason is not {self.kind.reason!r}, but {self.reason!r}"


def run_fault(rig: FaultRig, kind: FaultKind) -> FaultRun:
    """Bring ``rig`` to RUN, inject the fault, and end it."""
    rig.ensure_running()
    begin = time.monotonic()
    must_damp = kind.reaction in _DAMPS
    limit = begin + max(kind.duration_s, _DAMP_TIMEOUT_S if must_damp else 0.0)

    def over(observed: Observed) -> bool:
        return observed.damped_ns is not None or time.monotonic() > limit

    observed = rig.observe(lambda: kind.begin(rig), over)
    damped = observed.damped_ns is not None
    if damped:
        end = str(State.DAMP)
    else:
        rig.clear_faults()
        deadline = time.monotonic() + _RECOVERY_S
        while not rig.running and time.monotonic() < deadline:
            time.sleep(0.01)
        end = rig.mode or "no report"
    reference = observed.onset_ns if kind.since_onset else observed.last_good_ns
    row = FaultRun(
        kind,
        end,
        _ms(observed.held_ns, reference),
        _ms(observed.damped_ns, reference),
        observed.max_change,
        sum(not command.valid for command in observed.commands),
        _reason(observed, kind.reason),
    )
    if damped or end != State.RUN:
        rig.end_run()
    return row


def _ms(time_ns: int | None, since_ns: int) -> float | None:
    return None if time_ns is None else (time_ns - since_ns) / 1e6


def _reason(observed: Observed, expected: str) -> str:
    """Reason of the change to the worst state; of several, the first that contains ``expected``."""
    changes = [event.partition(": ") for event in observed.events if " -> " in event]
    for state in (State.DAMP, State.HOLD):
        reasons = [reason for change, _, reason in changes if change.endswith(f"-> {state}")]
        if reasons:
            return next((reason for reason in reasons if expected in reason), reasons[0])
    return ""


def percentile(values: Sequence[float | None], q: float) -> float | None:
    """Percentile of the values that are not None; None if there are none."""
    numbers = [value for value in values if value is not None]
    return float(np.percentile(numbers, q)) if numbers else None


def markdown(rows: Sequence[FaultRun]) -> str:
    """Table with one line per fault."""
    lines = [
        "| fault | end state | HOLD, ms | DAMP, ms (median, p99) | largest change, rad |",
        "|---|---|---|---|---|",
    ]
    kinds = list(dict.fromkeys(row.kind for row in rows))
    for kind in kinds:
        same = [row for row in rows if row.kind is kind]
        ends = sorted({row.end for row in same})
        held = percentile([row.held_ms for row in same], 50)
        damped = [row.damped_ms for row in same]
        both = [percentile(damped, q) for q in (50, 99)]
        change = max(row.max_change for row in same)
        shown = "" if both[0] is None else ", ".join(f"{v:.0f}" for v in both if v is not None)
        hold = "" if held is None else f"{held:.0f}"
        lines.append(f"| {kind.name} | {', '.join(ends)} | {hold} | {shown} | {change:.3f} |")
    return "\n".join(lines) + "\n"
