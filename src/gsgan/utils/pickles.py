"""Pickled data read without running it: SMPL files, ``annots.npy``, caches of other projects.

A pickle is a program. Here it may build dicts, lists, numbers, text and numpy arrays, and name the
few classes in `ALLOWED`, each replaced by a stand-in of ours; anything else is refused by name
before it is called. Whatever is wrong with a file becomes one `DataError`.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsgan.utils import pickle_types as types
from gsgan.utils.errors import DataError
from gsgan.utils.pickle_scan import Refused, check_unfolded, scan
from gsgan.utils.pickle_types import Budget, Call, StandIn

GROWTH, SPARE_BYTES = 4, 2**28
"""Arrays may take ``GROWTH`` times the file's size and ``SPARE_BYTES`` more (sparse matrices)."""
LARGEST_MEMBER = 2**30  # bytes of one array in an npz, unpacked
SPARSE = {"csc": types.SparseColumns, "csr": types.SparseRows, "coo": types.Sparse}

Name = tuple[str, str]


def _allowed() -> dict[Name, Callable[[Budget], Any]]:
    """What a pickle may name: (module, name) to what it gets, given the file's budget."""
    core = ("numpy.core", "numpy._core")
    table: dict[Name, Callable[[Budget], Any]] = {
        ("numpy", "ndarray"): lambda _: types.ARRAY_TYPE,
        ("numpy", "dtype"): lambda _: Call(types.DType),
        ("_codecs", "encode"): lambda budget: Call(partial(types.encode, budget)),
        ("chumpy.ch", "Ch"): lambda _: types.Chumpy,
        ("chumpy.reordering", "Select"): lambda _: types.ChumpySelect,
    }
    for module in core:
        table |= {
            (f"{module}.multiarray", "_reconstruct"): lambda b: Call(partial(types.reconstruct, b)),
            (f"{module}.multiarray", "scalar"): lambda _: Call(types.scalar),
            (f"{module}.numeric", "_frombuffer"): lambda b: Call(partial(types.from_buffer, b)),
        }
    for kind, stand_in in SPARSE.items():
        for module in (f"scipy.sparse.{kind}", f"scipy.sparse._{kind}"):
            for name in (f"{kind}_matrix", f"{kind}_array"):
                table[module, name] = lambda _, stand_in=stand_in: stand_in  # type: ignore[misc]
    for module in ("copyreg", "copy_reg"):
        table[module, "_reconstructor"] = lambda _: Call(types.reconstructor)
    for module in ("builtins", "__builtin__"):
        table |= {(module, "object"): lambda _: object, (module, "set"): lambda _: set}
    return table


ALLOWED = _allowed()


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, budget: Budget) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")
        self.budget = budget

    def find_class(self, module: str, name: str) -> Any:
        make = ALLOWED.get((module, name))
        if make is None:
            raise Refused(f"{module}.{name}")
        return make(self.budget)


@contextmanager
def _as_data_error(path: Path, what: str) -> Iterator[None]:
    """Anything that goes wrong inside becomes a sentence that names the file."""
    try:
        yield
    except DataError:
        raise
    except FileNotFoundError:
        raise DataError(f"{path} does not exist") from None
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from None
    except Refused as error:
        raise DataError(
            f"{path} asks for {error}, which is not on the list of harmless classes (a pickle can "
            "run code); nothing was run: save its content as plain arrays with numpy.savez"
        ) from None
    except Exception as error:
        raise DataError(
            f"{path} is not a whole {what} ({_reason(error)}); copy or export it again"
        ) from None


def _reason(error: Exception) -> str:
    text = f"it has no {error}" if isinstance(error, KeyError) else str(error)
    text = " ".join(text.split())[:160]
    return text or type(error).__name__


def read_pickle(path: Path) -> Any:
    """What a .pkl file holds, sparse matrices and chumpy's values as plain arrays.

    Convention: text and bytes of Python 2 are read as latin1; arrays deep inside tuples may be of a
    subclass of ndarray.

    Args:
        path: a pickle of any protocol.

    Raises:
        DataError: when the file is missing, damaged, or names a class that is not allowed.
    """
    with _as_data_error(path, "pickle"):
        return _load(path.read_bytes())


def _load(data: bytes) -> Any:
    scan(data)
    budget = Budget(GROWTH * len(data) + SPARE_BYTES)
    content = _Unpickler(data, budget).load()
    check_unfolded(content, len(data))
    return _plain(content, budget)


def _plain(root: Any, budget: Budget) -> Any:
    """The same with stand-ins as arrays, in dicts, lists and arrays of objects."""
    box = [root]
    todo: list[Any] = [box]
    seen: set[int] = set()
    while todo:
        holder = todo.pop()
        if isinstance(holder, np.ndarray):
            holder = holder.reshape(-1)
        entries = list(holder.items()) if isinstance(holder, dict) else list(enumerate(holder))
        for key, value in entries:
            new = value
            if isinstance(value, StandIn):
                new = types.as_array(value, budget)
            if isinstance(new, types.Array):
                new = new.view(np.ndarray)
            if new is not value:
                holder[key] = new
            if _holds_objects(new) and id(new) not in seen:
                seen.add(id(new))
                todo.append(new)
    return box[0]


def _holds_objects(value: Any) -> bool:
    return isinstance(value, dict | list) or (
        isinstance(value, np.ndarray) and value.dtype.hasobject
    )


def read_npy(path: Path) -> Any:
    """What a .npy file holds: a plain array, or the object of a 0-d array of objects.

    Args:
        path: of numpy's format 1 or 2; ``annots.npy`` gives its dict.

    Raises:
        DataError: when the file is missing, damaged, shorter or longer than its header promises,
            or names a class that is not allowed.
    """
    with _as_data_error(path, ".npy file"), path.open("rb") as stream:
        return _read_array(stream, path.stat().st_size)


def read_npz(
    path: Path, names: Iterable[str] | None = None, *, objects: bool = True
) -> dict[str, Any]:
    """The arrays of an .npz file by name, objects through the same gate as a pickle.

    Args:
        path: of numpy's format.
        names: the arrays wanted (those that are not there are left out); None for all.
        objects: whether an array may hold objects.

    Raises:
        DataError: when the file is missing or damaged, an array would unpack to more than
            `LARGEST_MEMBER` bytes, or names a class that is not allowed.
    """
    with _as_data_error(path, "npz file"), zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        found = {}
        for name in members if names is None else names:
            if (info := members.get(name)) is None:
                continue
            if info.file_size > LARGEST_MEMBER:
                raise ValueError(f"{name} would unpack to {info.file_size} bytes")
            with archive.open(info) as stream:
                content = io.BytesIO(stream.read())
            if not objects:
                _refuse_objects(content, path)
            found[name] = _read_array(content, info.file_size)
        return found


def _refuse_objects(stream: BinaryIO, path: Path) -> None:
    if _header(stream)[2].hasobject:
        raise DataError(
            f"{path} holds pickled Python objects, which can run code when read and are refused; "
            "save plain numeric arrays with numpy.savez"
        )
    stream.seek(0)


def _read_array(stream: BinaryIO, size: int) -> Any:
    shape, fortran, dtype = _header(stream)
    if dtype.hasobject:
        return _objects(stream.read(), shape, dtype)
    held, promised = size - stream.tell(), math.prod(shape) * dtype.itemsize
    if held != promised or dtype.itemsize == 0 or min(shape, default=0) < 0:
        raise ValueError(
            f"its header promises {promised} bytes of {dtype} {shape}, {held} are there"
        )
    content = np.frombuffer(bytearray(stream.read(promised)), dtype)  # writable
    return content.reshape(shape, order="F" if fortran else "C")


def _header(stream: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise ValueError(f"version {version} of the format, expected 1 or 2")
    return readers[version](stream)


def _objects(data: bytes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
    content = _load(data)
    fits = isinstance(content, np.ndarray) and content.dtype == dtype and content.shape == shape
    if not fits:
        raise ValueError("its header and its content differ")
    array: NDArray[Any] = content
    return array.item() if array.ndim == 0 else array
