"""Every fault, once, against the fake G1 over ZMQ.

``benchmarks/live_faults.py`` repeats them on loaded cores and checks the times.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.robots.fault_kinds import FAULTS, FaultKind, Reaction
from tests.support.robots.fault_rig import FaultRig
from tests.support.robots.fault_runs import DAMP_LIMIT_MS, run_fault

_ATTEMPTS = 3  # a busy machine also delays sensors and planner


@pytest.fixture(scope="module")
def rig() -> Iterator[FaultRig]:
    found = FaultRig()
    yield found
    found.close()


def test_there_are_at_least_60_faults() -> None:
    assert len({kind.name for kind in FAULTS}) == len(FAULTS) >= 60


@pytest.mark.parametrize("kind", FAULTS, ids=lambda kind: kind.name)
def test_the_reaction_is_the_required_one(rig: FaultRig, kind: FaultKind) -> None:
    for _ in range(_ATTEMPTS):
        row = run_fault(rig, kind)
        assert not row.invalid  # never, however busy the machine is
        late = kind.reaction is Reaction.DAMP and (row.damped_ms or 0.0) > 2 * DAMP_LIMIT_MS
        if not row.problem and not late:
            break
    assert not row.problem
    assert not late, f"damped after {row.damped_ms:.0f} ms"
