"""Console entry points: interrupts, pipes, encodings and missing packages."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

from egovcp.entry_point import EntryPoint

type Run = Callable[..., subprocess.CompletedProcess[bytes]]

INTERRUPT = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
MAIN = "def main(argv):\n"
RUN_COMMAND = """
from dataclasses import dataclass
from egovcp.cli import run_command

@dataclass(frozen=True)
class Config:
    count: int = 1

def main(argv):
    return run_command(Config, run, argv, prog="egovcp-test")

"""


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """``run(text, ...)`` runs a command whose module has this text."""

    def run(text: str, *argv: str, prefix: str = "", **options: object) -> object:
        (tmp_path / "command_under_test.py").write_text(text, encoding="utf-8")
        start = (
            "import sys; from egovcp.entry_point import EntryPoint; "
            "sys.exit(EntryPoint('egovcp-test', 'command_under_test')())"
        )
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        environment |= dict(options.pop("env", {}))  # type: ignore[call-overload]
        given: dict[str, object] = {"capture_output": True, **options}
        shell = f'{prefix} exec "$@"' if "|" not in prefix else prefix
        return subprocess.run(
            ["/bin/bash", "-c", shell, "bash", sys.executable, "-c", start, *argv],
            env=environment,
            cwd=tmp_path,
            check=False,
            timeout=60,
            **given,  # type: ignore[call-overload]
        )

    return run  # type: ignore[return-value]


def test_version_is_printed_without_importing_the_command() -> None:
    start = "from egovcp.entry_point import EntryPoint; EntryPoint('egovcp-x', 'egovcp.absent')()"
    command = [sys.executable, "-c", start, "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == f"egovcp-x {version('egovcp')}\n"


# --- Ctrl-C -----------------------------------------------------------------------------
def test_an_interrupt_during_an_import_that_swallows_it_ends_the_command(run: Run) -> None:
    done = run(
        f"try:\n    import os, signal\n    {INTERRUPT.splitlines()[1]}\nexcept BaseException:\n"
        f"    pass\n{MAIN}    return 0\n"
    )
    assert (done.returncode, done.stderr) == (130, b"egovcp-test: interrupted\n")


def test_an_interrupt_during_work_ends_the_command(run: Run) -> None:
    body = "def run(config):\n    import os, signal, time\n    try:\n"
    body += "        os.kill(os.getpid(), signal.SIGINT); time.sleep(30)\n"
    body += "    finally:\n        print('cleaned up')\n"
    done = run(f"{RUN_COMMAND}{body}")
    assert done.returncode == 130
    assert done.stdout == b"cleaned up\n"
    assert done.stderr == b"egovcp-test: interrupted\n"


@pytest.mark.parametrize(
    ("name", "context"),
    [("SIGINT", "contextlib.nullcontext([])"), ("SIGTERM", "workers.stop_on_signal()")],
)
def test_an_interrupt_during_a_late_import_is_delivered_after_it(
    name: str, context: str, run: Run, tmp_path: Path
) -> None:
    """Without `stop_on_signal` the first signal is one, with it the second."""
    late = f"try:\n    import os, signal\n    os.kill(os.getpid(), signal.{name})\n"
    late += "except BaseException:\n    pass\n"
    (tmp_path / "late_import.py").write_text(late, encoding="utf-8")
    body = "import contextlib, time\nfrom egovcp import workers\ndef run(config):\n"
    body += f"    with {context} as received:\n        received.append(15)\n"
    body += "        import late_import\n        print('imported', flush=True)\n"
    done = run(f"{RUN_COMMAND}{body}        time.sleep(30)\n")
    assert done.returncode == 130
    assert done.stdout == b"imported\n"
    assert done.stderr == b"egovcp-test: interrupted\n"


def test_an_interrupt_after_work_prints_no_traceback(run: Run) -> None:
    late = "import atexit, os, signal\natexit.register(os.kill, os.getpid(), signal.SIGINT)\n"
    done = run(f"{late}{MAIN}    return 0\n")
    assert (done.returncode, done.stderr) == (130, b"egovcp-test: interrupted\n")


def test_a_job_in_the_background_of_a_script_still_ignores_interrupts(run: Run) -> None:
    done = run(f"{INTERRUPT}{MAIN}    return 0\n", prefix="trap '' INT;")
    assert done.returncode == 0


# --- output -----------------------------------------------------------------------------
MANY_LINES = (
    f"{MAIN}    from egovcp.terminal import echo\n    for i in range(100000):\n        echo(i)\n"
)


def test_a_reader_that_has_gone_ends_the_command_quietly(run: Run) -> None:
    done = run(f"{MANY_LINES}    return 0\n", prefix='"$@" | head -1; exit ${PIPESTATUS[0]}')
    assert (done.returncode, done.stdout, done.stderr) == (141, b"0\n", b"")


def test_a_full_disk_under_stdout_is_an_environment_failure(run: Run) -> None:
    done = run(f"{MANY_LINES}    return 0\n", prefix="exec 1>/dev/full;")
    assert done.returncode == 5
    assert done.stderr.startswith(b"egovcp-test: error: cannot write the output")
    assert done.stderr.count(b"\n") == 1


@pytest.mark.parametrize("env", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}])
def test_any_text_can_be_printed_in_any_encoding(run: Run, env: dict[str, str]) -> None:
    text = f"{MAIN}    from egovcp.terminal import echo\n    echo('\\u00b5 \\u2192 \\udcff')\n"
    done = run(f"{text}    print('\\u2192')\n    return 0\n", env=env)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\udcff" in done.stdout


@pytest.mark.parametrize("closed", ["1>&-", "2>&-", "0<&-", "0<&- 1>&- 2>&-"])
def test_closed_standard_streams_do_not_matter(run: Run, closed: str, tmp_path: Path) -> None:
    text = f"{MAIN}    from egovcp.terminal import echo\n    file = open('result', 'w')\n"
    text += "    echo('out'); echo('err', error=True); print('x')\n    file.write('kept')\n"
    done = run(f"{text}    file.close()\n    return 0\n", prefix=f"exec {closed};")
    assert done.returncode == 0
    assert (tmp_path / "result").read_text(encoding="utf-8") == "kept"


def test_log_messages_are_escaped(run: Run) -> None:
    text = f"{MAIN}    import logging\n    logging.warning('from %s', '\\x1b[31m')\n    return 0\n"
    assert b"\\x1b[31m" in run(text).stderr


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["check", "--env.camera={a: [0, 1]}", "ball"], None),
        (["check", "--env.camera", "{a: [0, 1]}", "my:Task"], "my:Task"),
        (["check", "my:Task"], "my:Task"),
        (["check", "--task", "my:Task"], "my:Task"),
        (["check", "--env.task=my:Task"], "my:Task"),
        (["check", "--json", "-", "my:Task"], "my:Task"),
        (["check", "--debug", "my:Task"], "my:Task"),
        (["play", "--log.rrd", "my:Task"], "my:Task"),
    ],
)
def test_only_the_argument_of_a_task_names_one(
    argv: list[str], expected: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[str] = []
    register = lambda text: found.append(text) or "name"  # type: ignore[func-returns-value]  # noqa: E731
    monkeypatch.setattr("egovcp.sim.tasks.registry.register_task", register)
    EntryPoint("egovcp-test", "none", task_argument=1)._with_task(argv)
    assert found == ([expected] if expected else [])


# --- failures ---------------------------------------------------------------------------
def test_a_missing_package_is_named_with_the_command_that_installs_it(run: Run) -> None:
    done = run(f"import no_such_package.part\n{MAIN}    return 0\n")
    assert done.returncode == 5
    expected = b"egovcp-test: error: egovcp-test needs no-such-package, which is not installed"
    assert done.stderr.startswith(expected)
    assert done.stderr.count(b"\n") == 1


def test_a_hub_variable_that_is_no_number_is_named(run: Run) -> None:
    done = run(f"{MAIN}    return 0\n", env={"HF_HUB_DOWNLOAD_TIMEOUT": "abc"})
    assert done.returncode == 5
    assert done.stderr.startswith(b"egovcp-test: error: HF_HUB_DOWNLOAD_TIMEOUT=abc: expected")


def test_an_error_without_a_file_is_not_blamed_on_the_output(run: Run) -> None:
    done = run(f"{MAIN}    raise FileNotFoundError(2, 'No such file or directory')\n")
    assert done.returncode == 1
    assert b"cannot write the output" not in done.stderr


def test_a_bug_has_exit_code_1_and_an_escaped_traceback(run: Run) -> None:
    done = run(f"{MAIN}    raise RuntimeError('bug \\x1b[31m')\n")
    assert done.returncode == 1
    assert b"Traceback" in done.stderr
    assert b"\\x1b[31m" in done.stderr
    assert b"\x1b" not in done.stderr


def test_a_bug_in_an_import_of_our_own_is_no_missing_package(run: Run) -> None:
    done = run(f"import egovcp.no_such_module\n{MAIN}    return 0\n")
    assert done.returncode == 1


def test_entry_points_import_nothing_heavy() -> None:
    """Ctrl-C is handled from the start."""
    code = (
        "import sys; from importlib import metadata\n"
        "for entry in metadata.entry_points(group='console_scripts'):\n"
        "    if entry.name.startswith('egovcp-'): entry.load()\n"
        "print({'numpy', 'torch', 'mujoco', 'draccus', 'argparse'} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert done.stdout == b"set()\n"
