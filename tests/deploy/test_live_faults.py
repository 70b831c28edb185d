"""Every kind of fault, once, against the fake G1 over the real wire.

``benchmarks/live_faults.py`` repeats them on loaded cores and judges the times.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from egovcp_deploy.fault_injection.kinds import FAULTS, FaultKind
from egovcp_deploy.fault_injection.rig import FaultRig
from egovcp_deploy.fault_injection.table import Row, markdown, run_fault

_ATTEMPTS = 3  # a machine that is busy with other things delays sensors and planner as well


@pytest.fixture(scope="module")
def rig() -> Iterator[FaultRig]:
    found = FaultRig()
    yield found
    found.close()


@pytest.fixture(scope="module")
def rows() -> Iterator[list[Row]]:
    """Those of all kinds that were tested; printed at the end."""
    found: list[Row] = []
    yield found
    print("\n" + markdown(found))


def test_there_are_at_least_60_kinds() -> None:
    assert len({kind.name for kind in FAULTS}) == len(FAULTS) >= 60


@pytest.mark.parametrize("kind", FAULTS, ids=lambda kind: kind.name)
def test_fault_ends_as_it_must(rig: FaultRig, rows: list[Row], kind: FaultKind) -> None:
    for _ in range(_ATTEMPTS):
        row = run_fault(rig, kind)
        assert not row.unsound  # never, however busy the machine is
        if not row.problem:
            break
    rows.append(row)
    assert not row.problem
