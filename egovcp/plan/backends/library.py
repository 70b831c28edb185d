"""The C kernel, compiled for this processor on first use and kept in the user's cache folder."""

from __future__ import annotations

import ctypes
import hashlib
import multiprocessing
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Final, NamedTuple

from egovcp.errors import EnvironmentFailure
from egovcp.terminal import echo
from egovcp.trusted_cache import TrustedCache, load_library, user_cache_folder

SOURCE: Final = Path(__file__).parent / "kernel" / "kernel.c"
FLAGS: Final = (
    "-O3",
    "-march=native",
    *(("-mprefer-vector-width=512",) if platform.machine() == "x86_64" else ()),  # GCC: x86 only
    "-std=gnu11",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fwrapv",
    "-shared",
    "-fPIC",
)
WITHOUT_AMX: Final = "-DWITHOUT_AMX"
FLOAT32_HINT: Final = "plan with --planner.backend=float32"


_F, _I, _P = ctypes.c_float, ctypes.c_int32, ctypes.c_void_p


def _fields(kind: type, names: str) -> list[tuple[str, type]]:
    return [(name, kind) for name in names.split()]


# Each structure mirrors the kernel's structure of the same name without the prefix C.


class CWide(ctypes.Structure):
    _fields_ = (("inputs", _I), *_fields(_P, "weight scale start shift"))


class CNarrow(ctypes.Structure):
    _fields_ = (("inputs", _I), ("weight", _P))


class CLayer(ctypes.Structure):
    _fields_ = (
        ("outputs", _I),
        *_fields(CWide, "wide second"),
        ("narrow", CNarrow),
        *_fields(_P, "gamma beta"),
        ("epsilon", _F),
    )


class CDot(ctypes.Structure):
    _fields_ = (("inputs", _I), ("weight", _P), *_fields(_F, "scale bias"))


class CTop(ctypes.Structure):
    _fields_ = (("outputs", _I), ("wide", CWide), ("bias", _P))


class CHead(ctypes.Structure):
    _fields_ = (*_fields(CLayer, "first second"), ("scalar_top", CDot), ("vector_top", CTop))


class CReadout(ctypes.Structure):
    _fields_ = (
        *_fields(_I, "objective rule bins"),
        ("bin_values", _P),
        *_fields(_F, "mean std floor threshold discount"),
    )


class CNetwork(ctypes.Structure):
    _fields_ = (
        *_fields(_I, "hidden latent actions"),
        *_fields(CLayer, "mix gru prior termination"),
        ("prior_top", CTop),
        ("termination_top", CDot),
        ("min_std", _F),
        *_fields(CHead, "value reward"),
        *_fields(_P, "silu tanh"),
        ("readout", CReadout),
    )


class CSharedPrefix(ctypes.Structure):
    _fields_ = (*_fields(_P, "h mix gates value reward"), ("nan_or_zero", _F))


class CPrefixWeights(ctypes.Structure):
    _fields_ = (*_fields(_I, "hidden latent gates heads mix"), *_fields(_P, "h_weights z_weights"))


class CThreadPool(ctypes.Structure):
    _fields_ = _fields(_I, "next turn active workers")


class CJob(ctypes.Structure):
    _fields_ = (
        *_fields(_P, "network prefix"),
        *_fields(_I, "plans steps"),
        *_fields(_P, "actions noise values"),
        ("pool", CThreadPool),
    )


class Threads:
    """Evaluates the plans of a job on several threads, among them the caller's.

    The workers are woken at the start of a plan, and return after a millisecond without a job. One
    job is evaluated at a time.
    """

    def __init__(self, kernel: ctypes.CDLL, count: int) -> None:
        self._kernel = kernel
        self._workers = count - 1
        self._pool = ThreadPoolExecutor(count - 1, "planner") if count > 1 else None
        self._job = CJob()
        self._address = ctypes.byref(self._job)
        self._lock = Lock()

    def wake(self) -> None:
        """Wake the workers, before a job."""
        if self._pool is not None:
            for _ in range(self._kernel.missing_workers(self._address, self._workers)):
                self._pool.submit(self._kernel.work, self._address)

    def evaluate(self, **job: int | None) -> None:
        """Evaluate a job; returns when all threads have finished it.

        Args:
            job: numbers and addresses, the fields of `CJob`.
        """
        with self._lock:
            for name, value in job.items():
                setattr(self._job, name, value)
            self.wake()
            self._kernel.evaluate(self._address)


@cache
def processor_is_fast() -> bool:
    """Whether this processor has AVX-512 VNNI, or AVX2 and FMA, for which the kernel is written."""
    return processor_has("avx512_vnni") or (processor_has("avx2") and processor_has("fma"))


def processor_has(feature: str) -> bool:
    """Whether Linux lists it among this processor's features."""
    info = Path("/proc/cpuinfo")
    return info.exists() and feature in info.read_text(encoding="utf-8", errors="replace")


def compiler() -> str | None:
    """Path of a C compiler."""
    names = (os.environ.get("CC", ""), "cc", "gcc", "clang")
    return next((path for name in names if name and (path := shutil.which(name))), None)


@cache
def load_kernel() -> ctypes.CDLL:
    """The kernel, from the user's cache folder; compiled in about 2 s if it is not there.

    Raises:
        EnvironmentFailure: there is no compiler, or it fails, or another user can write to the
            cache folder.
    """
    flags = FLAGS if request_amx_tiles() else (*FLAGS, WITHOUT_AMX)
    name = f"planner-{_identity(flags)}.so"
    try:
        content = _cached(name, flags)
        kernel = load_library(content, name)
    except EnvironmentFailure as error:
        raise EnvironmentFailure(
            f"the int8 planner cannot be used: {error}; {FLOAT32_HINT}"
        ) from None
    except OSError as error:
        raise EnvironmentFailure(
            f"the int8 planner cannot be compiled or loaded ({error}); {FLOAT32_HINT}"
        ) from error
    for symbol, result, *arguments in (
        ("evaluate", None, _P),
        ("work", None, _P),
        ("draw", None, _I, _I, _I, _P, _P, _P, _P),
        ("walk", None, _I, _I, _I, _I, _F, _P, _P, _P),
        ("update", None, _I, _I, _I, _I, _F, _P, _P, _P, _P, _P, _P, _P),
        ("shared_prefix", _F, _P, _P, _P, _P, _P),
        ("missing_workers", _I, _P, _I),
        ("weight_layout", None, _P, _P, _P),
    ):
        function = getattr(kernel, symbol)
        function.restype, function.argtypes = result, arguments
    return kernel


class WeightLayout(NamedTuple):
    """Memory layout of the weights of wide products for this processor."""

    depth: int  # inputs are padded with zeros to a multiple of it
    lanes: int  # outputs per vector
    group: int  # adjacent inputs


def weight_layout(kernel: ctypes.CDLL) -> WeightLayout:
    """The layout of a kernel."""
    found = [ctypes.c_int32() for _ in WeightLayout._fields]
    kernel.weight_layout(*map(ctypes.byref, found))
    return WeightLayout(*(x.value for x in found))


def request_amx_tiles() -> bool:
    """Ask Linux to let this process use AMX; returns whether it may, and the processor has it."""
    if not processor_has("amx_int8"):
        return False
    arch_prctl, ask_for, tile_data = 158, 0x1023, 18  # <asm/prctl.h>: ARCH_REQ_XCOMP_PERM
    answer: int = ctypes.CDLL(None).syscall(arch_prctl, ask_for, tile_data)
    return answer == 0


@cache
def load_kernel_if_possible() -> ctypes.CDLL | None:
    """`load_kernel`; None where it cannot be used, which is reported on stderr once."""
    try:
        return load_kernel()
    except EnvironmentFailure as error:
        warn_float32(str(error))
        return None


@cache
def warn_float32(reason: str) -> None:
    """Warn once, on stderr, that ``--planner.backend=auto`` computes in float32."""
    _warn(f"{reason.removesuffix(f'; {FLOAT32_HINT}')}. Planning in float32, which is slower")


def _warn(text: str) -> None:
    if multiprocessing.parent_process() is None:  # not in every worker
        echo(f"egovcp: warning: {text}", error=True)


def _cached(name: str, flags: Sequence[str]) -> bytes:
    """The compiled kernel; not cached if there is no cache folder."""
    folder = user_cache_folder()
    if folder is None:
        _warn_uncached("the user has no home folder")
        return _compile(flags)
    try:
        cache = TrustedCache(folder)
    except OSError as error:
        _warn_uncached(f"{error.filename or folder}: {error.strerror}")
        return _compile(flags)
    content = cache.read(name)
    if content is None:
        content = _compile(flags)
        try:
            cache.write(name, content)
        except OSError as error:
            _warn_uncached(f"{folder}: {error.strerror}")
    return content


def _warn_uncached(reason: str) -> None:
    _warn(
        f"the compiled planner cannot be cached ({reason}) and is compiled again by every "
        "process; set XDG_CACHE_HOME to a folder of your own"
    )


def _identity(flags: Sequence[str]) -> str:
    """Hash of the source, the flags and the processor (``-march=native``)."""
    digest = hashlib.sha256()
    for path in sorted(SOURCE.parent.glob("*.[ch]")):
        digest.update(path.read_bytes())
    digest.update(repr((flags, compiler(), platform.machine())).encode())
    info = Path("/proc/cpuinfo")
    lines = info.read_text(errors="replace").splitlines() if info.exists() else []
    for line in lines:
        if line.startswith(("model name", "flags", "Features")):
            digest.update(line.encode())
        if not line:
            break  # the first processor is enough
    return digest.hexdigest()[:16]


def _compile(flags: Sequence[str]) -> bytes:
    """Compile the kernel to a shared library.

    Raises:
        EnvironmentFailure: there is no compiler, or it fails.
        OSError: the temporary folder cannot be written.
    """
    command = compiler()
    if command is None:
        raise EnvironmentFailure(
            "it is compiled on first use, and there is no C compiler (cc, gcc or clang, or $CC); "
            "install one"
        )
    with tempfile.TemporaryDirectory(prefix="egovcp-") as folder:
        made = Path(folder) / "planner.so"
        arguments = [command, *flags, str(SOURCE), "-o", str(made), "-lm"]
        try:
            done = subprocess.run(
                arguments, capture_output=True, text=True, errors="replace", check=False
            )
        except OSError as error:
            raise EnvironmentFailure(
                f"cannot run the compiler {command}: {error.strerror}"
            ) from error
        if done.returncode or not made.is_file():
            reason = " ".join(done.stderr.split())[:300] or f"exit code {done.returncode}"
            raise EnvironmentFailure(f"{command} cannot compile {SOURCE}: {reason}")
        return made.read_bytes()
