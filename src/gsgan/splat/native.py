"""The compiled compositing kernel for CPUs: native.cpp, built on first use, called through ctypes.

The shared library is compiled by the system's compiler into a user cache (``GSGAN_CACHE``, else
``$XDG_CACHE_HOME/gsgan``, else ``~/.cache/gsgan``; subfolder ``native``) and loaded from there
later. Where that cannot be done ``available()`` is False, ``why_not()`` says why, nothing raises.
"""

from __future__ import annotations

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
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from gsgan.splat.project import Projected
    from gsgan.splat.settings import Accuracy

SOURCE = Path(__file__).with_name("native.cpp")
COMPILERS = ("c++", "g++", "clang++")
COMPILE_SECONDS = 300.0
# Memory the backward pass may use for gradients per (tile, Gaussian) before it adds them up.
SLOT_BYTES = 1 << 28

# No -ffast-math: NaN and infinity keep their meaning, sums keep their order.
_BASE = (
    *("-std=c++17", "-O3", "-fPIC", "-shared", "-fopenmp-simd"),
    *("-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"),
)
# Tried in this order: some compilers lack OpenMP (Apple's clang), some the flag for the own CPU.
_FLAGS = (
    ("-march=native", "-mprefer-vector-width=512", "-fopenmp"),
    ("-march=native", "-fopenmp"),
    ("-mcpu=native", "-fopenmp"),
    ("-mcpu=native",),
    ("-march=native",),
    ("-fopenmp",),
    (),
)

_DTYPES = {torch.float32: "float32", torch.float64: "float64"}
_OUT_OF_MEMORY, _NOT_FINITE = 1, 2

_SIZES = ("B", "N", "C", "H", "W", "threads", "keep", "slot_bytes")
_INPUTS = ("means", "conics", "opacities", "features", "depths", "extents")
_OUTPUTS = ("out_features", "out_alpha", "out_depth")
_GRADS_OUT = ("g_features", "g_alpha", "g_depth")
_GRADS_IN = ("d_means", "d_conics", "d_opacities", "d_features", "d_depths")


class _Job(ctypes.Structure):
    """Mirrors ``struct Job`` of native.cpp field by field."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in _SIZES),
        *((name, ctypes.c_double) for name in ("alpha_min", "transmittance_min", "alpha_max")),
        *((name, ctypes.c_void_p) for name in (*_INPUTS, "visible", *_OUTPUTS)),
        *((name, ctypes.c_void_p) for name in (*_GRADS_OUT, *_GRADS_IN)),
        ("bad", ctypes.c_int64),
    )


class _Unavailable(Exception):
    """Why there is no kernel, in one sentence."""


# ------------------------------------------------------------------------------------------ use


def available() -> bool:
    """Whether the kernel can be used here; the first call may compile it (seconds).

    Returns:
        False where no compiler is found or works; ``why_not()`` then says why.
    """
    return _load()[0] is not None


def why_not() -> str:
    """Why the kernel is not available.

    Returns:
        One sentence; empty where the kernel is available.
    """
    return _load()[1]


def composite(
    projected: Projected, size: tuple[int, int], settings: Accuracy, want_depth: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Blends ellipses front to back on the CPU.

    Convention: pixel centres at +0.5; ``alpha = min(alpha_max, o exp(-q / 2))`` inside the extent,
    skipped below ``alpha_min`` and where the incoming transmittance is below
    ``transmittance_min``; ordered by depth, ties by index. Where alpha is capped, no gradient
    reaches opacity and shape. Same input, same bits, whatever the number of threads
    (``torch.get_num_threads()``).

    Args:
        projected: the ellipses, float32 or float64, on the CPU.
        size: (H, W) pixels.
        settings: alpha_min, transmittance_min and alpha_max are read; the extent is already in
            ``projected.extents``.
        want_depth: whether to blend depths too.

    Returns:
        features ``[B, C, H, W]`` premultiplied, alpha ``[B, 1, H, W]``, depth ``[B, 1, H, W]`` or
        None. Differentiable once in means, conics, opacities, features, and in depths through the
        depth output.

    Raises:
        ValueError: on another device or dtype, on mixed ones, and on a visible Gaussian that is not
            finite.
        RuntimeError: where ``available()`` is False.

    Source: paper Sec. 3.1; tiles after 3D Gaussian splatting, gradients derived in native.cpp.
    """
    _check(projected, size)
    features, alpha, depth = _Composite.apply(
        projected.means,
        projected.conics,
        projected.opacities,
        projected.features,
        projected.depths,
        projected.extents,
        projected.visible,
        size,
        (settings.alpha_min, settings.transmittance_min, settings.alpha_max),
        want_depth,
        torch.is_grad_enabled(),
    )
    return features, alpha, depth


def _check(projected: Projected, size: tuple[int, int]) -> None:
    B, N = projected.depths.shape
    C = projected.features.shape[-1]
    shapes = {
        "means": (B, N, 2),
        "conics": (B, N, 3),
        "opacities": (B, N),
        "features": (B, N, C),
        "depths": (B, N),
        "extents": (B, N, 2),
        "visible": (B, N),
    }
    dtype = projected.means.dtype
    for name, shape in shapes.items():
        value: Tensor = getattr(projected, name)
        if tuple(value.shape) != shape:
            raise ValueError(f"composite: {name} must be {list(shape)}, got {list(value.shape)}")
        if value.device.type != "cpu":
            raise ValueError(
                f"composite: the native backend needs {name} on the CPU, got {value.device}"
            )
        if value.dtype != (torch.bool if name == "visible" else dtype):
            raise ValueError(f"composite: {name} must be {dtype} like means, got {value.dtype}")
    if dtype not in _DTYPES:
        raise ValueError(f"composite: means must be float32 or float64, got {dtype}")
    if len(size) != 2 or min(size) < 1:
        raise ValueError(f"composite: size must be (H, W) with both at least 1, got {size}")


class _Plan:
    """What the backward pass needs of the forward pass; memory of the library, freed with it."""

    def __init__(self, library: ctypes.CDLL, suffix: str) -> None:
        self.pointer = ctypes.c_void_p()
        self._free = getattr(library, f"gsgan_free_{suffix}")

    def __del__(self) -> None:
        if self.pointer:
            self._free(self.pointer)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        conics: Tensor,
        opacities: Tensor,
        features: Tensor,
        depths: Tensor,
        extents: Tensor,
        visible: Tensor,
        size: tuple[int, int],
        cutoffs: tuple[float, float, float],
        want_depth: bool,
        grad_enabled: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        inputs = [
            x.detach().contiguous() for x in (means, conics, opacities, features, depths, extents)
        ]
        shown = visible.contiguous()
        (B, N, C), (H, W) = features.shape, size
        library = _library()
        suffix = _DTYPES[means.dtype]
        outputs = [means.new_empty(B, C, H, W), means.new_empty(B, 1, H, W)]
        if want_depth:
            outputs.append(means.new_empty(B, 1, H, W))
        keep = grad_enabled and any(ctx.needs_input_grad)
        job = _job(B, N, C, size, cutoffs, inputs, shown)
        job.keep = keep
        _point(job, _OUTPUTS, outputs)
        plan = _Plan(library, suffix)
        status = getattr(library, f"gsgan_forward_{suffix}")(
            ctypes.byref(job), ctypes.byref(plan.pointer)
        )
        _raise_for(status, job)
        if keep:
            ctx.save_for_backward(means, conics, opacities, features, depths, extents, visible)
            ctx.plan, ctx.size, ctx.cutoffs = plan, size, cutoffs
            ctx.set_materialize_grads(False)
        features_out, alpha, *rest = outputs
        return features_out, alpha, rest[0] if rest else None

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        *tensors, visible = ctx.saved_tensors
        inputs = [x.detach().contiguous() for x in tensors]
        shown = visible.contiguous()
        B, N, C = inputs[3].shape
        job = _job(B, N, C, ctx.size, ctx.cutoffs, inputs, shown)
        incoming = [None if g is None else g.contiguous() for g in grads]
        _point(job, _GRADS_OUT, incoming)
        with_depth = incoming[2] is not None
        outgoing: list[Tensor | None] = [
            torch.zeros_like(x) for x in inputs[: 5 if with_depth else 4]
        ]
        _point(job, _GRADS_IN, outgoing)
        suffix = _DTYPES[inputs[0].dtype]
        status = getattr(_library(), f"gsgan_backward_{suffix}")(
            ctypes.byref(job), ctx.plan.pointer
        )
        _raise_for(status, job)
        if not with_depth:
            outgoing.append(None)
        wanted = [
            g if need else None for g, need in zip(outgoing, ctx.needs_input_grad, strict=False)
        ]
        return (*wanted, *[None] * (len(ctx.needs_input_grad) - len(wanted)))


def _job(
    B: int,
    N: int,
    C: int,
    size: tuple[int, int],
    cutoffs: tuple[float, float, float],
    inputs: list[Tensor],
    visible: Tensor,
) -> _Job:
    job = _Job(B, N, C, *size, max(1, torch.get_num_threads()), 0, SLOT_BYTES, *cutoffs)
    _point(job, (*_INPUTS, "visible"), [*inputs, visible])
    return job


def _point(job: _Job, names: tuple[str, ...], tensors: list[Tensor] | list[Tensor | None]) -> None:
    # The pointers do not keep the tensors alive: the caller holds them until the call returns.
    for name, tensor in zip(names, tensors, strict=False):
        setattr(job, name, None if tensor is None else tensor.data_ptr())


def _raise_for(status: int, job: _Job) -> None:
    if status == 0:
        return
    if status == _NOT_FINITE:
        b, n = divmod(job.bad, job.N)
        raise ValueError(
            f"composite: visible Gaussians must be finite, got NaN or infinity in the mean, conic, "
            f"opacity, depth or extent of Gaussian {n} of batch item {b}"
        )
    if status == _OUT_OF_MEMORY:
        raise MemoryError("composite: out of memory; use a smaller picture, batch or extent")
    raise ValueError(
        f"composite: {job.B} pictures of {job.H} x {job.W} with {job.N} Gaussians make more than "
        "2^32 pairs of tile and Gaussian; use a smaller picture, batch or extent"
    )


# ---------------------------------------------------------------------------------- build and load

_LOCK = threading.Lock()


def _library() -> ctypes.CDLL:
    library, reason = _load()
    if library is None:
        raise RuntimeError(f"composite: the native kernel is not available: {reason}")
    return library


def _load() -> tuple[ctypes.CDLL | None, str]:
    with _LOCK:  # two threads must not compile at once
        return _load_once()


@functools.lru_cache(maxsize=1)
def _load_once() -> tuple[ctypes.CDLL | None, str]:
    try:
        compiler = _compiler()
        folder = _cache_folder()
        key = _key(compiler)
        for path in _cached(folder, key):
            library = _open(path)
            if library is not None:
                return library, ""
        library = _open(_build(compiler, folder, key))
    except _Unavailable as reason:
        return None, str(reason)
    except OSError as error:
        return None, f"The native kernel cannot be built: {error}."
    if library is None:
        return None, "The native kernel was compiled but cannot be loaded."
    return library, ""


def _compiler() -> list[str]:
    """The command of the compiler; ``CXX`` is a choice that is not second-guessed."""
    named = shlex.split(os.environ.get("CXX", ""))
    if named:
        if shutil.which(named[0]) is None:
            raise _Unavailable(f"The compiler that CXX names, {named[0]!r}, is not found.")
        return named
    for name in COMPILERS:
        if (path := shutil.which(name)) is not None:
            return [path]
    raise _Unavailable(
        f"No C++ compiler is found (looked for {', '.join(COMPILERS)}); install one or set CXX."
    )


def _cache_folder() -> Path:
    """Where compiled kernels live; created, for this user only, when missing."""
    root = os.environ.get("GSGAN_CACHE") or None
    if root is None:
        base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
        root = os.path.join(base, "gsgan")
    folder = Path(root) / "native"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise _Unavailable(
            f"The cache folder {folder} cannot be created ({error.strerror}); set GSGAN_CACHE to a "
            "folder that can be written."
        ) from error
    return folder


def _key(compiler: list[str]) -> str:
    """Names what a compiled kernel depends on: source, flags, compiler, CPU."""
    parts = (_source(), repr(_BASE), repr(_FLAGS), repr(compiler), _version(compiler), _cpu())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def _source() -> str:
    if not SOURCE.is_file():
        raise _Unavailable(f"The kernel's source {SOURCE} is missing; reinstall gsgan.")
    return SOURCE.read_text(encoding="utf-8")


def _version(compiler: list[str]) -> str:
    done = _run([*compiler, "--version"])
    if done.returncode != 0:
        raise _Unavailable(f"The compiler {shlex.join(compiler)!r} does not run.")
    return done.stdout


def _cpu() -> str:
    """What -march=native stands for here: a home folder may be shared by unlike machines."""
    lines = [platform.machine(), platform.processor()]
    info = Path("/proc/cpuinfo")
    if info.is_file():
        wanted = ("model name", "flags", "CPU implementer", "CPU part", "Features")
        lines += sorted(
            {x for x in info.read_text(errors="replace").splitlines() if x.startswith(wanted)}
        )
    return "\n".join(lines)


def _cached(folder: Path, key: str) -> Iterator[Path]:
    """Whole files of that key. A file's name ends with its own hash: loading a damaged one would
    crash the process, so those are deleted."""
    for path in sorted(folder.glob(f"{key}-*.so")):
        if path.stem.rpartition("-")[2] == _digest(path):
            yield path
        else:
            path.unlink(missing_ok=True)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:24]


def _build(compiler: list[str], folder: Path, key: str) -> Path:
    """Compiles beside the cache and renames when whole: a process that looks sees all or nothing.

    Returns:
        The shared library.

    Raises:
        _Unavailable: when no set of flags compiles.
    """
    message = ""
    with tempfile.TemporaryDirectory(dir=folder, prefix="build-") as work:
        target = Path(work) / "native.so"
        for flags in _FLAGS:
            done = _run([*compiler, *_BASE, *flags, str(SOURCE), "-o", str(target)])
            if done.returncode == 0 and target.is_file():
                final = folder / f"{key}-{_digest(target)}.so"
                os.replace(target, final)
                return final
            message = message or _first_error(done.stderr)
    raise _Unavailable(
        f"The compiler {shlex.join(compiler)!r} failed on the native kernel{message}."
    )


def _first_error(stderr: str) -> str:
    lines = [line.strip().rstrip(".") for line in stderr.splitlines() if "error" in line.lower()]
    return f": {lines[0]}" if lines else ""


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            command, capture_output=True, text=True, timeout=COMPILE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise _Unavailable(
            f"The compiler {command[0]!r} did not finish in {COMPILE_SECONDS:.0f} s."
        ) from error


def _open(path: Path) -> ctypes.CDLL | None:
    """The library with its functions declared, or None where it cannot be loaded."""
    try:
        library = ctypes.CDLL(str(path))
        library.gsgan_job_size.restype = ctypes.c_int64
        if library.gsgan_job_size() != ctypes.sizeof(_Job):
            return None
        for suffix in _DTYPES.values():
            getattr(library, f"gsgan_forward_{suffix}").argtypes = (
                ctypes.POINTER(_Job),
                ctypes.POINTER(ctypes.c_void_p),
            )
            getattr(library, f"gsgan_backward_{suffix}").argtypes = (
                ctypes.POINTER(_Job),
                ctypes.c_void_p,
            )
            getattr(library, f"gsgan_free_{suffix}").argtypes = (ctypes.c_void_p,)
            getattr(library, f"gsgan_free_{suffix}").restype = None
    except (OSError, AttributeError):
        return None
    return library
