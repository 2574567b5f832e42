"""A device with values where there is no GPU: its tensors refuse what tensors of a GPU refuse.

They report the device `META`, and hold a tensor of the CPU, which computes. An operation on tensors
of both devices is an error, as on a GPU, and so is `numpy`. Only copies, numbers without dimensions
and indices of the host are allowed.
"""

from contextlib import contextmanager, nullcontext

import torch
from torch.optim import optimizer
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from gsgan.body import compiled
from gsgan.skeleton import draw
from gsgan.skeleton import tensors as skeleton_tensors
from gsgan.splat import native
from gsgan.utils import tensors

META = torch.device("meta")
aten = torch.ops.aten
INDEXING = (aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_)
# What is made once for a device.
CACHES = (tensors._constant, skeleton_tensors.constants, draw._segment_ends)


class Remote(torch.Tensor):
    """A tensor of the other device; ``held`` has its values."""

    @staticmethod
    def __new__(cls, held):
        return torch.Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=META,
        )

    def __init__(self, held):
        self.held = held

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})

    def numpy(self, *_, **__):
        raise TypeError("numpy() of a tensor of the other device")

    __array__ = numpy

    def tolist(self):
        return self.held.tolist()


def computed(func, args, kwargs):
    """The operation on the values that the tensors hold."""
    packet = func.overloadpacket
    leaves = tree_leaves((args, kwargs))
    remote = any(isinstance(x, Remote) for x in leaves)
    device = kwargs.get("device")

    # A copy to a device; operations that make a tensor name one too.
    there = remote if device is None else torch.device(device) == META
    if device is not None:
        kwargs = {**kwargs, "device": "cpu"}
    elif remote and packet is not aten.copy_:
        _refuse_mixed(packet, args, kwargs)

    result = func(*tree_map(_held, args), **tree_map(_held, kwargs))

    # Operations in place return the tensor that they were given.
    arguments = func._schema.arguments
    for given, argument in zip(args, arguments, strict=False):
        written = (
            argument.alias_info is not None and argument.alias_info.is_write
        )
        if written and isinstance(given, torch.Tensor):
            return given
    return tree_map(_remote, result) if there else result


def _refuse_mixed(packet, args, kwargs):
    # Indices may lie on the host, if what they index does not.
    checked = (args, kwargs)
    if packet in INDEXING:
        checked = (args[0], *args[2:3])
    for x in tree_leaves(checked):
        host = isinstance(x, torch.Tensor) and not isinstance(x, Remote)
        if host and x.dim() > 0:
            raise RuntimeError(f"{packet}: tensors of two devices")


def _held(x):
    return x.held if isinstance(x, Remote) else x


def _remote(x):
    plain = isinstance(x, torch.Tensor) and not isinstance(x, Remote)
    return Remote(x) if plain else x


class OtherDevice(TorchDispatchMode):
    """Sends all operations through `computed`: those that make tensors know their device only
    here."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})


@contextmanager
def other_device(monkeypatch):
    """`META` has values inside."""
    plain = {name: getattr(torch, name) for name in ("tensor", "as_tensor")}

    def made(name):
        def make(data, *args, device=None, **options):
            found = plain[name](data, *args, **options)
            return found if device is None else found.to(device)

        return make

    for name in plain:
        monkeypatch.setattr(torch, name, made(name))
    monkeypatch.setattr(
        torch.Tensor,
        "new_tensor",
        lambda self, data, dtype=None: plain["tensor"](
            data, dtype=dtype or self.dtype
        ).to(self.device),
    )
    # Compiled code reads its inputs on the host, and would refuse those of a real meta device.
    monkeypatch.setattr(compiled, "available", lambda _: native.available())
    # The optimisers of Adam are fused on devices that they know.
    monkeypatch.setattr(
        optimizer,
        "_get_fused_kernels_supported_devices",
        lambda: ["cpu", "meta"],
    )
    # It knows no meta device.
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    for cache in CACHES:
        cache.cache_clear()
    try:
        with OtherDevice():
            yield META
    finally:
        for cache in CACHES:
            cache.cache_clear()
