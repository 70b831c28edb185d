"""The compiled planner: cached safely, and if it cannot be used, float32 with the reason."""

import os
import pwd
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.plan import PlannerConfig
from egovcp.plan.backends import FloatEvaluator, Int8Evaluator, library, make_evaluator
from egovcp.plan.config import BackendName
from egovcp.testing import toy_model
from tests.support.limited import run_limited

needs_compiler = pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
OTHER_USER = 12345


def _clear_caches() -> None:
    for cached in (library.load_kernel, library.load_kernel_if_possible, library.warn_float32):
        cached.cache_clear()


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache folder; the processor counts as fast at int8, and a compile is quick."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(library, "processor_is_fast", lambda: True)
    monkeypatch.setattr(library, "FLAGS", ("-O0", "-shared", "-fPIC", "-std=gnu11"))
    _clear_caches()
    yield tmp_path / "cache" / "egovcp"
    _clear_caches()


def _evaluator(backend: BackendName) -> object:
    """What computes the plans in a process that has just started."""
    _clear_caches()
    return make_evaluator(toy_model(), PlannerConfig(backend=backend))


def _compiled(cache: Path) -> Path:
    (path,) = cache.glob("planner-*.so")
    return path


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Counts the runs of the compiler."""
    run = Mock(wraps=subprocess.run)
    monkeypatch.setattr(subprocess, "run", run)
    return run


# --- the cache ----------------------------------------------------------------------------
@needs_compiler
def test_the_kernel_is_compiled_once_into_a_private_folder(cache: Path, compilations: Mock) -> None:
    for _ in range(2):
        assert isinstance(_evaluator("int8"), Int8Evaluator)
    assert compilations.call_count == 1
    assert cache.stat().st_mode & 0o777 == cache.parent.stat().st_mode & 0o777 == 0o700
    digest = f"{_compiled(cache)}.sha256"
    subprocess.run(["sha256sum", "--check", "--quiet", digest], cwd=cache, check=True)
    assert len(list(cache.iterdir())) == 2, "temporary files were left"


@needs_compiler
def test_a_truncated_library_is_compiled_again(cache: Path, compilations: Mock) -> None:
    _evaluator("int8")
    for size in (0, 5000):
        with _compiled(cache).open("r+b") as file:
            file.truncate(size)
        assert isinstance(_evaluator("int8"), Int8Evaluator)
    assert compilations.call_count == 3
    assert _compiled(cache).stat().st_size > 5000


# --- a cache folder that others can write to ----------------------------------------------
@pytest.fixture
def planted(cache: Path, tmp_path: Path) -> Path:
    """Plant a library, with its digest, that creates a file when it is loaded; the file."""
    _evaluator("int8")
    marker, source = tmp_path / "executed", tmp_path / "planted.c"
    source.write_text(
        "#include <fcntl.h>\n__attribute__((constructor)) static void run(void) "
        f'{{ open("{marker}", O_CREAT | O_WRONLY, 0600); }}\n'
    )
    target, command = _compiled(cache), library.compiler()
    assert command is not None
    subprocess.run([command, "-shared", "-fPIC", str(source), "-o", str(target)], check=True)
    digest = subprocess.run(
        ["sha256sum", target.name], cwd=cache, check=True, capture_output=True
    ).stdout
    Path(f"{target}.sha256").write_bytes(digest)
    for file in cache.iterdir():
        file.chmod(0o600)
    return marker


def _open_to_all(cache: Path) -> None:
    cache.chmod(0o777)


def _open_parent(cache: Path) -> None:
    cache.parent.chmod(0o775)


def _linked(cache: Path) -> None:
    cache.rename(cache.parent / "real")
    cache.symlink_to(cache.parent / "real")


def _foreign(cache: Path) -> None:
    os.chown(cache, OTHER_USER, OTHER_USER)


@needs_compiler
@pytest.mark.parametrize(
    ("open_up", "reason"),
    [
        (_open_to_all, "can be written by other users (mode 0777); chmod go-w"),
        (_open_parent, "can be written by other users (mode 0775); chmod go-w"),
        (_linked, "is a symbolic link"),
        pytest.param(_foreign, "belongs to user id 12345, expected 0", marks=needs_root),
    ],
)
def test_a_library_planted_by_another_user_is_not_executed(
    open_up: Callable[[Path], None],
    reason: str,
    cache: Path,
    planted: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    open_up(cache)
    _clear_caches()
    for _ in range(2):
        assert isinstance(make_evaluator(toy_model(), PlannerConfig()), FloatEvaluator)
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert reason in message
    assert "XDG_CACHE_HOME" in message
    with pytest.raises(EnvironmentFailure, match=r"--planner\.backend=float32") as caught:
        _evaluator("int8")
    assert reason in str(caught.value)
    assert not planted.exists()


@needs_compiler
def test_the_planted_library_would_be_executed(cache: Path, planted: Path) -> None:
    """Else the test above could not fail."""
    with pytest.raises(AttributeError):
        _evaluator("int8")
    assert planted.exists()


# --- no cache folder, no compiler ---------------------------------------------------------
@needs_compiler
def test_a_user_without_account_and_home_plans_in_int8(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unknown(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    assert isinstance(_evaluator("auto"), Int8Evaluator)
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "the user has no home folder" in message
    assert "set XDG_CACHE_HOME" in message


@needs_compiler
@needs_root
@pytest.mark.parametrize("home", ["", "/"])
def test_an_unknown_user_id_plans_in_int8(home: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As under ``docker run --user 12345``."""
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("TMPDIR", "/tmp")

    def run() -> int:
        os.environ.pop("HOME", None)
        if home:
            os.environ["HOME"] = home
        os.setgid(OTHER_USER)
        os.setuid(OTHER_USER)
        import tempfile

        tempfile.tempdir = None
        print(type(_evaluator("auto")).__name__)
        return 0

    result = run_limited(run, seconds=60.0)
    assert not result.has_traceback, result.output
    assert "Int8Evaluator" in result.output
    assert result.output.count("warning:") == 1


@pytest.mark.parametrize("backend", ["auto", "int8"])
def test_without_a_compiler(
    backend: BackendName, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(library, "compiler", lambda: None)
    _expect_float32(backend, "there is no C compiler (cc, gcc or clang, or $CC); install", capsys)


@pytest.mark.parametrize("backend", ["auto", "int8"])
def test_a_compiler_that_fails(
    backend: BackendName,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("CC", "false")
    _expect_float32(backend, "false cannot compile", capsys)
    assert not list(cache.iterdir())


@needs_compiler
def test_compiler_messages_are_quoted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "FLAGS", ("--no-such-flag",))
    with pytest.raises(EnvironmentFailure, match="no-such-flag"):
        _evaluator("int8")


def _expect_float32(backend: BackendName, reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One line that says why; int8 itself is refused."""
    if backend == "int8":
        with pytest.raises(EnvironmentFailure) as caught:
            _evaluator(backend)
        message = str(caught.value)
        assert "; plan with --planner.backend=float32" in message
    else:
        for _ in range(2):
            assert isinstance(make_evaluator(toy_model(), PlannerConfig()), FloatEvaluator)
        message = capsys.readouterr().err
        assert message.startswith("egovcp: warning: ")
        assert message.count("\n") == 1
        assert "Planning in float32" in message
        assert "--planner.backend" not in message
    assert reason in message
