"""Pickles as Python 2 wrote them, byte strings and old module names included.

Python 3 cannot write these: its text is unicode and its bytes go through a codec. Classes are
named without being imported, so chumpy and scipy need not be there.
"""

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Instance:
    """An object of a class that is only named: ``module``, ``name``, and its ``__dict__``."""

    module: str
    name: str
    state: dict[str, Any] = field(default_factory=dict)


def chumpy(values: np.ndarray) -> Instance:
    """``chumpy.ch.Ch`` round an array."""
    return Instance(
        "chumpy.ch", "Ch", {"x": values, "_dirty_vars": set(), "_itr": None}
    )


def chumpy_select(values: np.ndarray, shape: tuple[int, ...]) -> Instance:
    """``chumpy.reordering.Select``: a block of a longer chumpy array."""
    longer = chumpy(np.concatenate([values.ravel(), np.zeros(5)]))
    state = {
        "a": longer,
        "idxs": np.arange(values.size),
        "preferred_shape": shape,
    }
    return Instance("chumpy.reordering", "Select", state)


def csc(dense: np.ndarray, module: str = "scipy.sparse.csc") -> Instance:
    """``csc_matrix`` of a dense one."""
    column, row = np.nonzero(dense.T)
    starts = np.searchsorted(column, np.arange(dense.shape[1] + 1)).astype(
        np.int32
    )
    state = {
        "format": "csc",
        "_shape": dense.shape,
        "maxprint": 50,
        "indptr": starts,
    }
    state |= {"data": dense.T[column, row], "indices": row.astype(np.int32)}
    return Instance(module, "csc_matrix", state)


def dumps(value: Any, protocol: int = 2) -> bytes:
    """A pickle of protocol 0 or 2 of dicts, tuples, numbers, text, arrays and instances."""
    return (
        (b"\x80\x02" if protocol == 2 else b"") + _write(value, protocol) + b"."
    )


def _write(value: Any, protocol: int) -> bytes:
    if value is None:
        return b"N"
    if isinstance(value, bool):
        return b"I0%d\n" % value
    if isinstance(value, int | np.integer):
        return b"I%d\n" % value
    if isinstance(value, float):
        return b"F%r\n" % value
    if isinstance(value, str):
        return _string(value.encode("latin1"), protocol)
    if isinstance(value, tuple):
        return b"(" + b"".join(_write(v, protocol) for v in value) + b"t"
    if isinstance(value, set):
        items = b"".join(_write(v, protocol) + b"a" for v in value)
        return b"c__builtin__\nset\n((l" + items + b"tR"
    if isinstance(value, dict):
        items = (
            _write(k, protocol) + _write(v, protocol) + b"s"
            for k, v in value.items()
        )
        return b"(d" + b"".join(items)
    if isinstance(value, Instance):
        return _instance(value, protocol)
    return _array(value, protocol)


def _string(value: bytes, protocol: int) -> bytes:
    if protocol == 0:
        return b"S" + repr(value)[1:].encode("ascii") + b"\n"
    if len(value) < 256:
        return b"U" + bytes([len(value)]) + value
    return b"T" + struct.pack("<i", len(value)) + value


def _instance(value: Instance, protocol: int) -> bytes:
    name = f"c{value.module}\n{value.name}\n".encode()
    state = _write(value.state, protocol) + b"b"
    if protocol == 2:
        return name + b")\x81" + state
    return (
        b"ccopy_reg\n_reconstructor\n("
        + name
        + b"c__builtin__\nobject\nNtR"
        + state
    )


def _array(array: np.ndarray, protocol: int) -> bytes:
    spec = array.dtype.str[1:]
    dtype = (
        b"cnumpy\ndtype\n("
        + _string(spec.encode(), protocol)
        + b"I0\nI1\ntR(I3\n"
    )
    dtype += (
        _string(b"<" if array.dtype.itemsize > 1 else b"|", protocol)
        + b"NNNI-1\nI-1\nI0\ntb"
    )
    start = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\nt"
    start += _string(b"b", protocol) + b"tR"
    shape = _write(tuple(array.shape), protocol)
    content = _string(np.ascontiguousarray(array).tobytes(), protocol)
    return start + b"(I1\n" + shape + dtype + b"I00\n" + content + b"tb"
