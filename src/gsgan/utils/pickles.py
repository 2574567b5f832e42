"""Reads pickled data, such as SMPL files and ``annots.npy``, without running it.

A pickle is a program. `_Unpickler` lets it build dicts, lists, numbers, text and numpy arrays, and
name the classes in `ALLOWED`, which are replaced by the stand-ins below; any other name is refused.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsgan.utils.errors import DataError

NDARRAY = "numpy.ndarray"  # pickles only name the class
LARGEST_ARRAY = 2**30  # bytes of one array, unpacked
DTYPE = re.compile(r"[<>|=]?([?bBhHiIlLqQefdgFDG]|[biufcSU][0-9]{1,6}|O8?)")


class _Refused(pickle.UnpicklingError):
    """The pickle names something that is not in `ALLOWED`."""


def _expect(condition: bool, otherwise: str) -> None:
    if not condition:
        raise pickle.UnpicklingError(otherwise)


class _DType:
    """``numpy.dtype``, of plain numbers, text and objects; its state only sets the byte order."""

    def __init__(self, name: Any, *_align_and_copy: Any) -> None:
        known = isinstance(name, str) and DTYPE.fullmatch(name) is not None
        _expect(known, f"it holds arrays of type {str(name)[:40]!r}")
        self.value = np.dtype(name)

    def __setstate__(self, state: Any) -> None:
        if state[1] in ("<", ">"):
            self.value = self.value.newbyteorder(state[1])


def _bytes(content: Any) -> bytes:
    return content.encode("latin1") if isinstance(content, str) else bytes(content)  # str: Python 2


def _from_buffer(content: Any, dtype: _DType, shape: Any, order: Any) -> NDArray[Any]:
    """How protocol 5 writes arrays."""
    flat = np.frombuffer(content, dtype.value).astype(dtype.value.newbyteorder("="))
    return flat.reshape(shape, order=order)


def _scalar(dtype: _DType, content: Any) -> Any:
    return np.frombuffer(_bytes(content), dtype.value)[0]


def _encode(text: str, _encoding: str) -> bytes:
    """How Python 3 writes bytes for Python 2."""
    return text.encode("latin1")


def _reconstruct(kind: Any, *_shape_and_code: Any) -> _Array:
    _expect(kind is NDARRAY, "it builds an array of an unknown class")
    return _Array()


def _reconstructor(kind: Any, base: Any, _state: Any) -> Any:
    """How protocols 0 and 1 make objects."""
    known = isinstance(kind, type) and issubclass(kind, _StandIn) and base is object
    _expect(known, "it builds an object of an unknown class")
    return kind()


class _StandIn:
    """Keeps the state of an object that is not built while reading: here chumpy's array."""

    def __init__(self, *_arguments: Any) -> None:
        self.state: dict[str, Any] = {}

    def __setstate__(self, state: Any) -> None:
        self.state = dict(state)

    def array(self) -> NDArray[Any]:
        """The array that the object stands for."""
        return _numbers(self.state["x"])


class _Array(_StandIn):
    """``numpy.ndarray``, which does not check all of its state itself."""

    def __setstate__(self, state: Any) -> None:
        self.state = dict(zip(("shape", "dtype", "fortran", "content"), state[-4:], strict=True))

    def array(self) -> NDArray[Any]:
        shape, dtype, fortran, content = self.state.values()
        order: Any = "F" if fortran else "C"
        if not dtype.value.hasobject:
            return _from_buffer(_bytes(content), dtype, shape, order)
        _expect(isinstance(content, list), "an array of objects has no list of them")
        flat = np.empty(len(content), object)
        flat[:] = content
        return flat.reshape(shape, order=order)


class _Select(_StandIn):
    """``chumpy.reordering.Select``: some entries of another array."""

    def array(self) -> NDArray[Any]:
        chosen = _numbers(self.state["a"]).ravel()[_numbers(self.state["idxs"])]
        return chosen.reshape(self.state.get("preferred_shape") or chosen.shape)


class _Sparse(_StandIn):
    """``scipy.sparse.csc_matrix``, as a dense array."""

    def array(self) -> NDArray[Any]:
        import scipy.sparse  # takes long, and few files need it

        shape = self.state["_shape" if "_shape" in self.state else "shape"]
        _expect(math.prod(shape) * 8 <= LARGEST_ARRAY, f"a sparse matrix of shape {shape}")
        parts = [_numbers(self.state[key]) for key in ("data", "indices", "indptr")]
        matrix = scipy.sparse.csc_matrix(tuple(parts), shape)
        matrix.check_format(full_check=True)
        return np.asarray(matrix.toarray(), np.float64)


def _numbers(value: Any) -> NDArray[Any]:
    array = value.array() if isinstance(value, _StandIn) else np.asarray(value)
    _expect(not array.dtype.hasobject, "an array of numbers holds objects")
    return array


ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): NDARRAY,
    ("numpy", "dtype"): _DType,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("_codecs", "encode"): _encode,
    ("copyreg", "_reconstructor"): _reconstructor,
    ("builtins", "object"): object,
    ("builtins", "set"): set,
    ("chumpy.ch", "Ch"): _StandIn,
    ("chumpy.reordering", "Select"): _Select,
    ("scipy.sparse.csc", "csc_matrix"): _Sparse,
}
RENAMED = {
    "__builtin__": "builtins",  # in Python 2
    "copy_reg": "copyreg",
    "numpy._core.multiarray": "numpy.core.multiarray",  # in numpy 2
    "numpy._core.numeric": "numpy.core.numeric",
    "scipy.sparse._csc": "scipy.sparse.csc",
}


class _Unpickler(pickle._Unpickler):
    """In Python: a damaged file makes the one in C reserve as much memory as a number names."""

    def find_class(self, module: str, name: str) -> Any:
        known = RENAMED.get(module, module), name
        if known not in ALLOWED:
            raise _Refused(f"{module}.{name}")
        return ALLOWED[known]


def _load(data: bytes) -> Any:
    return _plain(_Unpickler(io.BytesIO(data), encoding="latin1").load(), {})


def _plain(value: Any, done: dict[int, tuple[Any, Any]]) -> Any:
    """The same with arrays in place of stand-ins; ``done`` holds (value, result) by identity."""
    if not isinstance(value, _StandIn | dict | list | tuple):
        return value
    if id(value) in done:
        return done[id(value)][1]
    result = value.array() if isinstance(value, _StandIn) else value
    done[id(value)] = value, result
    if isinstance(result, tuple):
        result = tuple(_plain(entry, done) for entry in result)
        done[id(value)] = value, result
    elif isinstance(result, dict | list) or result.dtype.hasobject:
        flat = result.reshape(-1) if isinstance(result, np.ndarray) else result
        for key in list(flat) if isinstance(flat, dict) else range(len(flat)):
            flat[key] = _plain(flat[key], done)
    return result


@contextmanager
def _as_data_error(path: Path, what: str) -> Iterator[None]:
    """Turns whatever goes wrong inside into one sentence that names the file."""
    try:
        yield
    except FileNotFoundError:
        raise DataError(f"{path} does not exist") from None
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from None
    except _Refused as error:
        raise DataError(
            f"{path} asks for {error}, which is not allowed, since a pickle can run code; nothing "
            "was run: save its content as plain arrays with numpy.savez"
        ) from None
    except Exception as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        reason = " ".join(reason.split())[:160] or type(error).__name__
        raise DataError(f"{path} is not a valid {what} ({reason}); export it again") from None


def read_pickle(path: Path) -> Any:
    """The content of a .pkl file, with sparse matrices and chumpy's values as plain arrays.

    Convention: text and bytes of Python 2 are read as latin1.

    Raises:
        DataError: when the file is missing, damaged, or names a class that is not allowed.
    """
    with _as_data_error(path, "pickle"):
        return _load(path.read_bytes())


def read_npy(path: Path) -> Any:
    """The content of a .npy file, or the object of a 0-d array of objects; errors as above."""
    with _as_data_error(path, ".npy file"), path.open("rb") as stream:
        return _read_array(stream)


def read_npz(
    path: Path, names: Iterable[str] | None = None, *, objects: bool = True
) -> dict[str, Any]:
    """The arrays of an .npz file by name.

    Args:
        path: of numpy's format.
        names: of the requested arrays, those that are absent left out; None for all.
        objects: whether an array may hold objects, read like a pickle.

    Raises:
        DataError: when the file is missing or damaged, an array would unpack to more than
            `LARGEST_ARRAY` bytes, or names a class that is not allowed.
    """
    with _as_data_error(path, "npz file"), zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        found = {}
        for name in members if names is None else members.keys() & set(names):
            size = members[name].file_size
            _expect(size <= LARGEST_ARRAY, f"{name} would unpack to {size} bytes")
            stream = io.BytesIO(archive.read(members[name]))
            found[name] = _read_array(stream, objects)
        return found


def _read_array(stream: BinaryIO, objects: bool = True) -> Any:
    try:
        return np.lib.format.read_array(stream, allow_pickle=False)
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
    if not objects:
        raise _Refused("pickled Python objects")
    content = _load(stream.read())  # the header has been read
    return content.item() if isinstance(content, np.ndarray) and content.ndim == 0 else content
