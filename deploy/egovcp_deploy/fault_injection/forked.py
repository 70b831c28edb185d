"""The control process, forked from a server that has imported what it needs."""

from __future__ import annotations

import multiprocessing
import os
from dataclasses import replace
from multiprocessing.process import BaseProcess
from typing import Final

import egovcp.robot.controllers  # noqa: F401  # preloaded
from egovcp_deploy.live.priority import RECEIVING, raised_priority
from egovcp_deploy.live.process import ControlSetup, control_process

_FORKSERVER: Final = multiprocessing.get_context("forkserver")
# Each child imports the main module again: what that imports in turn is preloaded as well.
_FORKSERVER.set_forkserver_preload([__name__, "egovcp_deploy.fault_injection.table", "pytest"])


def _run(setup: ControlSetup) -> None:
    control_process(replace(setup, parent=os.getppid()))  # the server


def start_control_process(setup: ControlSetup) -> BaseProcess:
    """Start one; the process with which it must end is set here."""
    process = _FORKSERVER.Process(target=_run, args=(setup,), daemon=True)
    with raised_priority(RECEIVING):  # inherited by the server
        process.start()
    return process
