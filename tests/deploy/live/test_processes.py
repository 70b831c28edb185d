"""However a control process ends, the robot is damped."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

from egovcp_deploy.live import processes
from egovcp_deploy.live.processes import DampingWatchdog, stop_control


class Control:
    """Ends on ``hears``, and keeps a record of what was tried."""

    def __init__(self, hears: str, watchdog: SimpleNamespace) -> None:
        self._hears, self._watchdog = hears, watchdog
        self.tried: list[str] = []
        self.guarded_when_killed = False

    def is_alive(self) -> bool:
        return self._hears not in self.tried

    def join(self, timeout: float | None = None) -> None:
        self.tried.append("order")

    def terminate(self) -> None:
        self.tried.append("signal")

    def kill(self) -> None:
        self.guarded_when_killed = not self._watchdog.expected()
        self.tried.append("kill")


@pytest.mark.parametrize("quitting", [True, False])
@pytest.mark.parametrize("hears", ["order", "signal", "kill"])
def test_a_process_gets_sigterm_before_sigkill_after_which_the_watchdog_damps(
    hears: str, quitting: bool
) -> None:
    joined: list[bool] = []
    watchdog = SimpleNamespace(
        expected=lambda: quitting, join_if_ended=lambda: joined.append(control.is_alive())
    )
    control = Control(hears, watchdog)
    stop_control(control, watchdog)
    assert not control.is_alive()
    assert joined == [False]
    assert ("kill" in control.tried) == (hears == "kill")
    assert control.guarded_when_killed == (hears == "kill")
    if hears == "kill":
        assert control.tried.index("signal") < control.tried.index("kill")


def test_another_interrupt_shortens_the_wait_for_a_hanging_process() -> None:
    watchdog = SimpleNamespace(expected=lambda: True, join_if_ended=lambda: None)
    control = Control("kill", watchdog)
    stop_control(control, watchdog, interrupts=[2])
    assert control.tried.index("kill") < 30  # waits of 50 ms; 200 without an interrupt


@pytest.mark.parametrize(
    ("commanded", "expected", "damped"),
    [(True, False, 1), (True, True, 0), (False, False, 0)],
)
def test_the_watchdog_damps_a_robot_that_was_commanded_if_the_end_is_unexpected(
    commanded: bool, expected: bool, damped: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds: list[object] = []
    monkeypatch.setattr(processes, "damp_motors", rounds.append)
    monkeypatch.setattr(processes, "_WATCHDOG_ROUNDS", 1)
    sentinel, end = os.pipe()
    process = SimpleNamespace(sentinel=sentinel, is_alive=lambda: False)
    watchdog = DampingWatchdog(process, SimpleNamespace(), lambda: commanded)
    watchdog.expected = lambda: expected
    os.close(end)
    watchdog.join_if_ended()
    os.close(sentinel)
    assert len(rounds) == damped
    assert watchdog.acted == bool(damped)
