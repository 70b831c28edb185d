"""The limits of `run_limited` hold."""

import gc
import signal
import socket
import time

from tests.support.limited import run_limited


def test_returns_the_exit_code_and_the_output() -> None:
    def function() -> int:
        print("done")
        return 3

    result = run_limited(function)
    assert (result.exit_code, result.output) == (3, "done\n")
    assert not result.has_traceback
    assert not result.timed_out


def test_an_exception_is_a_traceback_and_a_failure() -> None:
    result = run_limited(lambda: {}["missing"])
    assert result.exit_code == 70
    assert result.has_traceback
    assert "KeyError" in result.output


def test_a_child_that_hangs_is_killed() -> None:
    def function() -> int:
        time.sleep(60)
        return 0

    result = run_limited(function, seconds=0.2)
    assert result.timed_out
    assert result.exit_code == -signal.SIGKILL
    assert result.seconds < 5


def test_memory_beyond_the_limit_is_refused() -> None:
    result = run_limited(lambda: len(bytearray(1 << 30)), memory_bytes=256 << 20)
    assert "MemoryError" in result.output


def test_memory_that_is_used_is_counted() -> None:
    gc.collect()  # what the child would free of earlier tests is not what it uses
    # The kernel may take back pages of libraries meanwhile: far more than what is asserted.
    result = run_limited(lambda: len(bytearray(b"x") * (768 << 20)) and 0)
    assert result.exit_code == 0
    assert result.memory_bytes > 100 << 20


def test_connections_are_refused() -> None:
    result = run_limited(lambda: bool(socket.create_connection(("127.0.0.1", 9), timeout=1)))
    assert result.exit_code == 70
    assert "connection to ('127.0.0.1', 9)" in result.output
