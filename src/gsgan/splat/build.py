"""Compiles the kernels on first use and loads them: no build step for the user.

The shared library is compiled by the system's compiler into a user cache (``GSGAN_CACHE``, else
``$XDG_CACHE_HOME/gsgan``, else ``~/.cache/gsgan``; subfolder ``native``) and loaded from there
later. A file's name is a hash of all that it depends on, so that no stale file is loaded.
``GSGAN_MARCH`` (e.g. ``x86-64``) compiles for that processor instead of this one. Where nothing can
be compiled, a library that came with the wheel is loaded.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsgan.splat.flags import BASE_FLAGS
from gsgan.utils.files import cache_root

# The kernels are one program, which includes the headers.
SOURCE = Path(__file__).with_name("native.cpp")
KERNEL_HEADERS = SOURCE.with_name("kernels")
# In wheels that were built with GSGAN_WHEEL_KERNELS=1 (hatch_build.py).
PACKAGED = SOURCE.with_name("prebuilt.so")
COMPILERS = ("c++", "g++", "clang++")
COMPILE_SECONDS = 300.0  # after which the compiler counts as hanging

# Tried in this order: some compilers have no OpenMP (Apple's clang) or no flags for this CPU.
_NATIVE_FLAGS = (
    ("-march=native", "-mprefer-vector-width=512", "-fopenmp"),
    ("-march=native", "-fopenmp"),
    ("-mcpu=native", "-fopenmp"),
    ("-mcpu=native",),
    ("-march=native",),
    ("-fopenmp",),
    (),
)

DTYPES = {torch.float32: "float32", torch.float64: "float64"}
# Functions of the library, one per dtype; each takes a job and at most one more pointer.
_FUNCTIONS = (
    # compositing: kernels/job.h
    "forward",
    "backward",
    "free",
    # projection: kernels/ewa.h
    "project",
    "project_backward",
    # parts of the model, losses and body
    "compose",
    "compose_backward",
    "skin",
    "skin_backward",
    "photometric",
    "solve",
)

_LOCK = threading.Lock()


class Unavailable(Exception):
    """Raised when the kernel cannot be used; the message gives the reason in one sentence."""


def library() -> tuple[ctypes.CDLL | None, str]:
    """The kernels, from the cache or compiled now (seconds); loaded once per process.

    Returns:
        The library and "", or None and the reason in one sentence.
    """
    # Two threads must not compile at once.
    with _LOCK:
        return _load_once()


def job_type(
    integers: Sequence[str],
    numbers: Sequence[str],
    addresses: Sequence[str],
    results: Sequence[str] = (),
) -> type[ctypes.Structure]:
    """The type of a kernel's argument, field by field as its header in kernels/ declares it.

    Args:
        integers: names of 64-bit integers.
        numbers: names of doubles.
        addresses: names of tensors' addresses.
        results: names of 64-bit integers that the kernel sets.
    """
    fields: list[tuple[str, Any]] = [
        (name, ctypes.c_int64) for name in integers
    ]
    fields += [(name, ctypes.c_double) for name in numbers]
    fields += [(name, ctypes.c_void_p) for name in addresses]
    fields += [(name, ctypes.c_int64) for name in results]
    return type("Job", (ctypes.Structure,), {"_fields_": fields})


def point(
    job: ctypes.Structure,
    names: Sequence[str],
    tensors: Sequence[Tensor | None],
) -> None:
    """Sets fields of a job to tensors' addresses; the caller keeps the tensors alive."""
    for name, tensor in zip(names, tensors, strict=False):
        setattr(job, name, None if tensor is None else tensor.data_ptr())


def threads() -> int:
    """The number of threads of a kernel."""
    return torch.get_num_threads()


def function(name: str, dtype: torch.dtype) -> Any:
    """A function of the library for a dtype.

    Raises:
        RuntimeError: when the library is not available.
    """
    loaded, reason = library()
    if loaded is None:
        raise RuntimeError(f"The native kernel is not available: {reason}")
    return getattr(loaded, f"gsgan_{name}_{DTYPES[dtype]}")


@functools.lru_cache(maxsize=1)
def _load_once() -> tuple[ctypes.CDLL | None, str]:
    try:
        # The file's name is a hash of all that a compiled kernel depends on.
        command = compiler()
        parts = (
            _source(),
            repr(BASE_FLAGS),
            repr(_flags()),
            repr(command),
            _version(command),
            _cpu(),
        )
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()
        path = _cache_folder() / f"{key[:24]}.so"

        # A file that is damaged is compiled again.
        loaded = open_library(path)
        if loaded is None:
            _build(command, path)
            loaded = open_library(path)
    except Unavailable as reason:
        packaged = _load_packaged()
        return packaged, str(reason) if packaged is None else ""
    except OSError as error:
        return None, f"The native kernel cannot be built: {error}."
    if loaded is None:
        return None, "The native kernel was compiled but cannot be loaded."
    return loaded, ""


def _load_packaged() -> ctypes.CDLL | None:
    """The library of the wheel, if there is one and this processor has its instructions."""
    # Those of x86-64-v3, by what torch found.
    plain = torch.backends.cpu.get_cpu_capability() == "DEFAULT"
    if platform.machine() == "x86_64" and plain:
        return None
    return open_library(PACKAGED)


def compiler() -> list[str]:
    """The compiler's command; with ``CXX`` set, no other one is tried."""
    # A command may have arguments, such as "ccache g++".
    named = shlex.split(os.environ.get("CXX", ""))
    if named:
        if shutil.which(named[0]) is None:
            raise Unavailable(
                f"The compiler {named[0]!r} from CXX is not found."
            )
        return named

    # The first one that is installed.
    for name in COMPILERS:
        if (path := shutil.which(name)) is not None:
            return [path]
    raise Unavailable(
        f"No C++ compiler is found (looked for {', '.join(COMPILERS)}); install one or set CXX."
    )


def _cache_folder() -> Path:
    """Folder of the compiled kernels; created, for this user only, when missing."""
    # Others must not be able to replace a library that is loaded here.
    folder = cache_root() / "native"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(
            f"The cache folder {folder} cannot be created ({error.strerror}); set GSGAN_CACHE to a "
            "folder that can be written."
        ) from error
    return folder


def _flags() -> tuple[tuple[str, ...], ...]:
    """Sets of flags to try, best first."""
    march = os.environ.get("GSGAN_MARCH")
    if not march:
        return _NATIVE_FLAGS
    processor = f"-march={march}"
    return (processor, "-fopenmp"), (processor,)


def _source() -> str:
    """The source of the kernels."""
    # An incomplete installation has no kernels, but works without them.
    headers = sorted(KERNEL_HEADERS.glob("*.h"))
    if not SOURCE.is_file() or not headers:
        raise Unavailable(
            f"The kernel's source {SOURCE} or {KERNEL_HEADERS} is missing; reinstall gsgan."
        )
    return "\0".join(
        path.read_text(encoding="utf-8") for path in (SOURCE, *headers)
    )


def _version(command: list[str]) -> str:
    done = _run([*command, "--version"])
    if done.returncode != 0:
        raise Unavailable(f"The compiler {shlex.join(command)!r} does not run.")
    return done.stdout


def _cpu() -> str:
    """The processor, on which -march=native depends: machines may share a home folder."""
    lines = [platform.machine(), platform.processor()]
    info = Path("/proc/cpuinfo")
    if info.is_file():
        # Processors of one kind have the same lines.
        fields = (
            "model name",
            "flags",
            "CPU implementer",
            "CPU part",
            "Features",
        )
        info_lines = info.read_text(errors="replace").splitlines()
        lines += sorted(
            {line for line in info_lines if line.startswith(fields)}
        )
    return "\n".join(lines)


def _build(command: list[str], library: Path) -> None:
    """Compiles under a temporary name and renames when complete.

    Raises:
        Unavailable: when no set of flags compiles.
    """
    # The message has the first error of the first set of flags that has one.
    message = ""
    with tempfile.TemporaryDirectory(
        dir=library.parent, prefix="build-"
    ) as work:
        target = Path(work) / "native.so"
        for flags in _flags():
            # The library appears under its name only when it is complete.
            done = _run(
                [*command, *BASE_FLAGS, *flags, str(SOURCE), "-o", str(target)]
            )
            if done.returncode == 0 and target.is_file():
                os.replace(target, library)
                return
            for line in done.stderr.splitlines():
                if not message and "error" in line.lower():
                    message = f": {line.strip().rstrip('.')}"
    raise Unavailable(
        f"The compiler {shlex.join(command)!r} failed on the native kernel{message}."
    )


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Runs a command to its end; the caller looks at its exit status."""
    try:
        return subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=COMPILE_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise Unavailable(
            f"The compiler {command[0]!r} did not finish in {COMPILE_SECONDS:.0f} s."
        ) from error


def open_library(path: Path) -> ctypes.CDLL | None:
    """The library with its functions declared, or None when it cannot be loaded."""
    try:
        loaded = ctypes.CDLL(str(path))
        # Compositing has a second pointer, to tile lists.
        for name in _FUNCTIONS:
            for dtype in DTYPES.values():
                declared = getattr(loaded, f"gsgan_{name}_{dtype}")
                pointers = 2 if name in ("forward", "backward") else 1
                declared.argtypes = (ctypes.c_void_p,) * pointers
                declared.restype = None if name == "free" else ctypes.c_int
    except (OSError, AttributeError):
        return None
    return loaded
