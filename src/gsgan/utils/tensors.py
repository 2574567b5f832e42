"""Small helpers for tensors: constants, precision, devices."""

import contextlib
import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from gsgan.utils.errors import ConfigError

Result = TypeVar("Result")
# of glibc's mallopt
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
KEPT = 1 << 30  # bytes of freed memory that the process keeps
# bytes; glibc takes larger blocks from the system in any case
LARGEST = 1 << 25


def constant(
    values: Any, like: Tensor, dtype: torch.dtype | None = None
) -> Tensor:
    """Nested tuples of numbers as a tensor on the device of ``like``, of its dtype unless another
    is given; read only."""
    # torch.export sees a stand-in, which must not be kept.
    make = _constant.__wrapped__ if torch.compiler.is_compiling() else _constant
    return make(values, dtype or like.dtype, like.device)


@lru_cache(maxsize=1024)
def _constant(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    # An inference tensor could not be used in training later.
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


def matvec(A: Tensor, v: Tensor) -> Tensor:
    """``[..., N]`` products of matrices ``[..., N, M]`` and vectors ``[..., M]``."""
    return (A @ v.unsqueeze(-1)).squeeze(-1)


def squared_norm(v: Tensor) -> Tensor:
    """``[..., 1]`` squared lengths of vectors ``[..., N]``."""
    return v.square().sum(-1, keepdim=True)


def fill(values: Any, like: Tensor) -> Tensor:
    """Like `constant` for values that change between calls: filled on the device, not copied."""
    if isinstance(values, tuple | list):
        return torch.stack([fill(value, like) for value in values])
    return like.new_full((), values)


@contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """Computes at the precision of the tensors' dtype: no autocast, TF32 or bfloat16 products.

    bf16 projections are off by pixels, and TF32 keeps 10 bits. Gradients that are computed outside
    have the precision that is set there.
    """
    # The settings of TF32 are global: they are restored at the end.
    tf32 = torch.backends.cudnn.allow_tf32
    products = torch.get_float32_matmul_precision()
    torch.backends.cudnn.allow_tf32 = False
    torch.set_float32_matmul_precision("highest")
    try:
        with torch.autocast(device.type, enabled=False):
            yield
    finally:
        torch.backends.cudnn.allow_tf32 = tf32
        torch.set_float32_matmul_precision(products)


def pick_device(name: str) -> torch.device:
    """The device of a name, checked to be usable.

    Args:
        name: ``auto`` (CUDA if available), ``cpu``, ``cuda`` or any other torch device.

    Raises:
        ConfigError: when it is not usable.
    """
    # Whether a device is usable shows when something is put there.
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(
            f"device={name}: not usable here; try device=cpu"
        ) from error


def keep_freed_memory() -> None:
    """Makes the process keep freed memory for its next image, if the C library is glibc.

    By default most of it goes back to the system, which maps and clears it anew for every image:
    16 thousand pages in an image of 256², a third of the time of painting it.
    """
    with contextlib.suppress(OSError, AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_TRIM_THRESHOLD, KEPT)
        mallopt(M_MMAP_THRESHOLD, LARGEST)


def derive(
    module: nn.Module, name: str, make: Callable[[], Result], *weights: Tensor
) -> Result:
    """``make()``, a function of these weights alone. In a frozen module (one with a dictionary
    ``derive``) it is kept until a weight changes or moves."""
    # While training every call computes anew.
    kept: dict[str, tuple[Any, Result]] | None = getattr(
        module, "derived", None
    )
    if kept is None:
        return make()

    # A change in place raises the version; a move or a cast changes the address or dtype.
    state = [(x.data_ptr(), x._version, x.dtype) for x in weights]
    entry = kept.get(name)
    if entry is None or entry[0] != state:
        with torch.inference_mode(False), torch.no_grad():
            entry = kept[name] = state, make()
    return entry[1]


def farthest_points(points: Tensor, count: int) -> Tensor:
    """``[count]`` indices of points ``[V, D]`` far from each other, the first one first.

    Meshes are dense in faces and hands; a subset in list order would leave arms and legs thin.
    A count of V keeps the points' own order.
    """
    if count == len(points):
        return torch.arange(count)
    # numpy: a third of torch's time at this size
    axes = np.ascontiguousarray(points.numpy().T)
    chosen = np.zeros(count, np.int64)
    nearest = np.full(len(points), np.inf, axes.dtype)

    # Each step takes the point that is farthest from all chosen ones.
    for i in range(1, count):
        squared = (axes - axes[:, chosen[i - 1], None]) ** 2
        np.minimum(nearest, squared.sum(0), out=nearest)
        chosen[i] = nearest.argmax()
    return torch.from_numpy(chosen)
