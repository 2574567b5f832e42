"""What a restricted pickle may hold: arrays, and stand-ins for classes of scipy and chumpy.

Everything here checks what it is given and then computes: a hostile file can at worst be refused.
numpy's own ``__setstate__`` is reached only with values that were checked before, because it trusts
lengths and dtype flags that a file can forge.
"""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[Any]
DTYPE = re.compile(r"[<>|=]?[?a-zA-Z][0-9]{0,6}")
KINDS = "biufcSUO"  # bool, whole, real, complex, bytes, text, object; no records, no dates


class Budget:
    """Bytes that one file may turn into: a few shared bytes must not become a full memory.

    Args:
        left: bytes.
    """

    def __init__(self, left: int) -> None:
        self.left = left

    def spend(self, size: int) -> None:
        """Takes ``size`` bytes.

        Raises:
            pickle.UnpicklingError: when that is more than is left.
        """
        self.left -= size
        if self.left < 0:
            raise pickle.UnpicklingError("its arrays would grow far larger than the file is")


class Call:
    """A function that a pickle may call but not change (BUILD could set attributes of a plain one).

    Args:
        function: what it does.
    """

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("it gives a function a state")


class DType:
    """A numpy dtype as a pickle writes it: a name, then a state that only sets the byte order."""

    def __init__(self, spec: Any, *_align_and_copy: Any) -> None:
        if not isinstance(spec, str) or not DTYPE.fullmatch(spec):
            raise pickle.UnpicklingError(f"it holds the array type {_told(spec)}")
        self.value = np.dtype(spec)
        if self.value.kind not in KINDS or self.value.itemsize == 0:
            raise pickle.UnpicklingError(f"it holds the array type {spec!r:.40}")

    def __setstate__(self, state: Any) -> None:
        _expect(isinstance(state, tuple) and len(state) >= 5, "an array type has a broken state")
        order, *record = state[1:5]
        _expect(order in ("<", ">", "|", "=") and record == [None] * 3, "it holds record arrays")
        if order in ("<", ">"):
            self.value = self.value.newbyteorder(order)


def _told(spec: Any) -> str:
    """At most 40 characters; what is no text may be endless to print."""
    return f"{spec[:38]!r}" if isinstance(spec, str) else type(spec).__name__


class Array(np.ndarray):
    """An array being unpickled."""

    budget: Budget

    def __setstate__(self, state: Any) -> None:
        _expect(isinstance(state, tuple) and len(state) in (4, 5), "an array has a broken state")
        shape, dtype, fortran, content = state[-4:]
        _expect(isinstance(dtype, DType), "an array has no type")
        if dtype.value.hasobject:
            _expect(isinstance(content, list), "an array of objects has no list of them")
            size = len(content)
        else:
            content, size = _raw(content), dtype.value.itemsize
            size = len(content) // size if len(content) % size == 0 else -1
        _expect(_is_shape(shape) and math.prod(shape) == size, "an array's shape and bytes differ")
        self.budget.spend(size * dtype.value.itemsize)
        checked: Any = (1, shape, dtype.value, bool(fortran), content)
        super().__setstate__(checked)


def _expect(condition: bool, otherwise: str) -> None:
    if not condition:
        raise pickle.UnpicklingError(otherwise)


def _is_shape(shape: Any) -> bool:
    return (
        isinstance(shape, tuple)
        and len(shape) <= 32
        and all(isinstance(n, int) and n >= 0 for n in shape)
    )


def _raw(content: Any) -> bytes:
    if isinstance(content, str):  # Python 2 wrote bytes as text
        return content.encode("latin1")
    _expect(isinstance(content, bytes | bytearray), "an array has no bytes")
    return bytes(content)


def reconstruct(budget: Budget, array_type: Any, shape: Any, _code: Any) -> Array:
    """numpy's ``_reconstruct``: an empty array whose content follows."""
    _expect(array_type is ARRAY_TYPE and shape == (0,), "it builds an array in an unknown way")
    array = Array.__new__(Array, (0,), np.dtype("b"))
    array.budget = budget
    return array


def from_buffer(budget: Budget, content: Any, dtype: Any, shape: Any, order: object) -> Array:
    """numpy's ``_frombuffer``, as pickle protocol 5 writes arrays."""
    _expect(order in ("C", "F"), "an array has an unknown order")
    array = reconstruct(budget, ARRAY_TYPE, (0,), b"b")
    array.__setstate__((shape, dtype, order == "F", _raw(content)))
    return array


def scalar(dtype: Any, content: Any) -> Any:
    """numpy's ``scalar``: one number."""
    _expect(isinstance(dtype, DType) and not dtype.value.hasobject, "a number has no type")
    raw = _raw(content)
    _expect(len(raw) == dtype.value.itemsize, "a number's type and bytes differ")
    return np.frombuffer(raw, dtype.value)[0]


def encode(budget: Budget, text: Any, coding: Any) -> bytes:
    """``_codecs.encode`` with latin1: how bytes are written for Python 2."""
    _expect(isinstance(text, str) and coding in ("latin1", "latin-1"), "it encodes text oddly")
    budget.spend(len(text))
    return text.encode("latin1")


def reconstructor(kind: Any, base: Any, state: Any) -> object:
    """``copyreg._reconstructor``, for the stand-ins below only."""
    known = isinstance(kind, type) and issubclass(kind, StandIn)
    _expect(known and base is object and state is None, "it builds an object in an unknown way")
    return kind()


class StandIn:
    """An object of a class that is not loaded: it keeps its state and gives the array it meant."""

    _value: Numbers | None = None

    def __init__(self, *_arguments: Any) -> None:
        self.state: dict[Any, Any] = {}

    def value(self, budget: Budget) -> Numbers:
        """The array it stands for, found once: selections of selections name it many times.

        Raises:
            Exception: as `array`.
        """
        if self._value is None:
            self._value = self.array(budget)
        return self._value

    def __setstate__(self, state: Any) -> None:
        _expect(isinstance(state, dict), f"a {type(self).__name__} has a broken state")
        self.state = state

    def array(self, budget: Budget) -> Numbers:
        """The array it stands for.

        Raises:
            Exception: any, on a state that does not fit; the caller turns it into a sentence.
        """
        raise NotImplementedError


class Chumpy(StandIn):
    """``chumpy.ch.Ch``: an array and what its derivatives need."""

    def array(self, budget: Budget) -> Numbers:
        """Its value ``x``."""
        return as_array(self.state["x"], budget)


class ChumpySelect(StandIn):
    """``chumpy.reordering.Select``: some entries of another array, reshaped."""

    def array(self, budget: Budget) -> Numbers:
        """``a.ravel()[idxs]`` in its preferred shape."""
        source = as_array(self.state["a"], budget).ravel()
        chosen = source[as_array(self.state["idxs"], budget).astype(np.int64)]
        budget.spend(chosen.nbytes)
        shape = self.state.get("preferred_shape")
        return chosen if shape is None else chosen.reshape(shape)


class Sparse(StandIn):
    """A sparse matrix of scipy, in any of its three common kinds."""

    def array(self, budget: Budget) -> Numbers:
        """The same matrix with its zeros; entries given twice are summed."""
        shape = self.state["_shape"] if "_shape" in self.state else self.state["shape"]
        shape = tuple(int(n) for n in shape)
        _expect(len(shape) == 2 and min(shape) >= 0, "a sparse matrix has no two sides")
        data = as_array(self.state["data"], budget)
        _expect(data.ndim == 1 and data.dtype.kind in "biuf", "a sparse matrix holds no numbers")
        budget.spend(math.prod(shape) * 8)
        dense = np.zeros(shape)
        row, column = self.entries(budget)
        _expect(len(row) == len(column) == len(data), "a sparse matrix misses entries")
        _expect(min(row.min(initial=0), column.min(initial=0)) >= 0, "an index is negative")
        np.add.at(dense, (row, column), data)
        return dense

    def entries(self, budget: Budget) -> tuple[Numbers, Numbers]:
        """Row and column of each entry."""
        coordinates = self.state.get("coords", ())
        row, column = (
            coordinates if len(coordinates) == 2 else (self.state["row"], self.state["col"])
        )
        return _indices(row, budget), _indices(column, budget)


class Compressed(Sparse):
    """Rows or columns after one another, their starts in ``indptr``."""

    def runs(self, budget: Budget) -> tuple[Numbers, Numbers]:
        """For each entry, the run it is in and its place there."""
        place = _indices(self.state["indices"], budget)
        lengths = np.diff(_indices(self.state["indptr"], budget))
        whole = lengths.min(initial=0) >= 0 and lengths.sum() == len(place)
        _expect(bool(whole), "a sparse matrix misses entries")
        return np.repeat(np.arange(len(lengths)), lengths), place


class SparseColumns(Compressed):
    """``csc_matrix``."""

    def entries(self, budget: Budget) -> tuple[Numbers, Numbers]:
        """Row and column of each entry."""
        column, row = self.runs(budget)
        return row, column


class SparseRows(Compressed):
    """``csr_matrix``."""

    def entries(self, budget: Budget) -> tuple[Numbers, Numbers]:
        """Row and column of each entry."""
        return self.runs(budget)


def _indices(value: Any, budget: Budget) -> Numbers:
    array = as_array(value, budget)
    _expect(array.ndim == 1 and array.dtype.kind in "iu", "indices are no whole numbers")
    return array.astype(np.int64)


def as_array(value: Any, budget: Budget) -> Numbers:
    """A plain numeric array from an array or a stand-in."""
    if isinstance(value, list | tuple):
        flat = all(isinstance(number, int | float | np.number) for number in value)
        _expect(flat, "lists lie in one another where an array belongs")
    array = value.value(budget) if isinstance(value, StandIn) else np.asarray(value)
    _expect(not array.dtype.hasobject, "an array holds objects where numbers belong")
    return array


class _ArrayType:
    """Stands for the class ``numpy.ndarray``, which a pickle only ever names."""

    __slots__ = ()


ARRAY_TYPE = _ArrayType()
