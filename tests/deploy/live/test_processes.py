"""However a control process ends, the robot is damped."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from egovcp_deploy.live.processes import stop_control


class Control:
    """Ends on ``hears``, and keeps a record of what was tried."""

    def __init__(self, hears: str, planner: SimpleNamespace) -> None:
        self._hears, self._planner = hears, planner
        self.tried: list[str] = []
        self.guarded_when_killed = False

    def is_alive(self) -> bool:
        return self._hears not in self.tried

    def join(self, timeout: float | None = None) -> None:
        self.tried.append("order")

    def terminate(self) -> None:
        self.tried.append("signal")

    def kill(self) -> None:
        self.guarded_when_killed = not self._planner.quitting
        self.tried.append("kill")


@pytest.mark.parametrize("quitting", [True, False])
@pytest.mark.parametrize("hears", ["order", "signal", "kill"])
def test_a_process_gets_sigterm_before_sigkill_after_which_the_watchdog_damps(
    hears: str, quitting: bool
) -> None:
    planner = SimpleNamespace(quitting=quitting)
    control = Control(hears, planner)
    stop_control(control, planner)
    assert not control.is_alive()
    assert ("kill" in control.tried) == (hears == "kill")
    assert control.guarded_when_killed == (hears == "kill")
    if hears == "kill":
        assert control.tried.index("signal") < control.tried.index("kill")
