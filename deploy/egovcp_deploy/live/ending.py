"""How a control process is brought to its end."""

from __future__ import annotations

from typing import Final, Protocol

END_S: Final = 5.0  # for the control process to say its last words


class Ending(Protocol):
    """What is needed of a process, `multiprocessing.Process` for one."""

    def is_alive(self) -> bool:
        """Whether it has not ended."""
        ...

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end, no longer than ``timeout`` s."""
        ...

    def terminate(self) -> None:
        """Ask it to end by a signal."""
        ...

    def kill(self) -> None:
        """End it."""
        ...


class Quitting(Protocol):
    """The planner's side."""

    quitting: bool
    """Whether the process is supposed to end; if it is not, the guard damps the robot."""


def end(process: Ending, planner: Quitting) -> None:
    """Wait for the control process. One that did not hear that it should end is asked by a signal,
    on which it damps too; one that has to be killed damps nothing, so the guard must."""
    if planner.quitting:
        process.join(END_S)
    if process.is_alive():
        planner.quitting = True
        process.terminate()
        process.join(END_S)
    if process.is_alive():
        planner.quitting = False
        process.kill()
        process.join()
