"""Reads pickled data, such as SMPL files and ``annots.npy``, without running code from the file.

A pickle is a program that may call any function. `_Unpickler` gives it only the names in
`ALLOWED`: they build numpy arrays, also of tensors, and stand-ins for the classes of chumpy and
scipy.
"""

import bz2
import copyreg
import io
import lzma
import math
import pickle
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsgan.utils.errors import DataError
from gsgan.utils.files import refuse_empty

# The first bytes of what joblib may compress with, and what undoes it. joblib names its own classes
# near the start of a file.
COMPRESSED: dict[bytes, Callable[[], Any]] = {
    b"x": zlib.decompressobj,
    b"\x1f\x8b": partial(zlib.decompressobj, wbits=31),
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ": lzma.LZMADecompressor,
    b"\x5d\0\0": lzma.LZMADecompressor,
}
JOBLIB_HEAD = 4096  # bytes
# What converts the first person of files that programs write with joblib.
WHAM = "numpy.savez('{made}', **joblib.load('{given}')[0])"
FOUR_D_HUMANS = (
    "people = [image['smpl'][0] for image in joblib.load('{given}').values() if image['smpl']]; "
    "numpy.savez('{made}', **{{key: numpy.stack([person[key] for person in people]) "
    "for key in ('global_orient', 'body_pose', 'betas')}})"
)
LARGEST_ARRAY = 2**30  # bytes of one array, unpacked


# -- stand-ins for the classes that files name


class _Refused(pickle.UnpicklingError):
    """The pickle names something that is not in `ALLOWED`."""


def _expect(condition: bool, otherwise: str) -> None:
    if not condition:
        raise pickle.UnpicklingError(otherwise)


class _DType:
    """Stands in for ``numpy.dtype``: numbers, text and objects; its state sets the byte order."""

    def __init__(self, name: str, *_align_and_copy: Any) -> None:
        self.value = np.dtype(name)
        _expect(
            self.value.kind in "biufcSUO", f"it holds arrays of type {name!r}"
        )

    def __setstate__(self, state: Any) -> None:
        # The second entry of numpy's state is the byte order.
        if state[1] in ("<", ">"):
            self.value = self.value.newbyteorder(state[1])


class _Array(np.ndarray):
    """Checks the pickled state first: numpy reads beyond it, or takes bytes for pointers."""

    def __setstate__(self, state: Any) -> None:
        # Objects are in a list, and numbers in bytes.
        shape, dtype, fortran, content = state[-4:]
        objects = dtype.value.hasobject
        content = content if objects else _bytes(content)
        _expect(
            isinstance(content, list) or not objects,
            "an array of objects has no list of them",
        )

        # The content must have exactly as many of them as the shape says.
        count = math.prod(shape) * (1 if objects else dtype.value.itemsize)
        _expect(
            min(shape, default=0) >= 0 and len(content) == count,
            f"an array of shape {shape} has other content",
        )
        super().__setstate__((1, shape, dtype.value, fortran, content))

    def __reduce__(self) -> Any:
        return np.asarray(self).__reduce__()


def _bytes(content: Any) -> bytes:
    # Bytes of Python 2 arrive as text.
    return (
        content.encode("latin1") if isinstance(content, str) else bytes(content)
    )


def _reconstruct(*_class_shape_and_code: Any) -> NDArray[Any]:
    return _Array((0,), np.uint8)


class _Chumpy:
    """Stands in for ``chumpy.ch.Ch``, an array."""

    state: dict[str, Any]

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.state = state

    def array(self) -> NDArray[Any]:
        """The array that the object stands for."""
        return _array(self.state["x"])


class _Select(_Chumpy):
    """Stands in for ``chumpy.reordering.Select``, some entries of another array."""

    def array(self) -> NDArray[Any]:
        chosen = _array(self.state["a"]).ravel()[_array(self.state["idxs"])]
        return chosen.reshape(self.state.get("preferred_shape") or chosen.shape)


class _Sparse(_Chumpy):
    """Stands in for ``scipy.sparse.csc_matrix``, whose own class does not check what it reads."""

    def array(self) -> NDArray[Any]:
        import scipy.sparse  # here: the import takes long, and few files need it

        shape = self.state.get("_shape") or self.state["shape"]
        _expect(
            math.prod(shape) * 8 <= LARGEST_ARRAY,
            f"a sparse matrix of shape {shape}",
        )

        # Indices beyond the shape are refused before anything is unpacked.
        parts = tuple(
            _array(self.state[key]) for key in ("data", "indices", "indptr")
        )
        matrix = scipy.sparse.csc_matrix(parts, shape)
        matrix.check_format(full_check=True)
        return np.asarray(matrix.toarray(), np.float64)


def _array(value: Any) -> NDArray[Any]:
    return value.array() if isinstance(value, _Chumpy) else np.asarray(value)


# -- names that a pickle may use


def _scalar(dtype: _DType, content: Any) -> Any:
    return np.frombuffer(_bytes(content), dtype.value)[0]


def _from_buffer(
    content: Any, dtype: _DType, shape: Any, order: Any
) -> NDArray[Any]:
    return (
        np.frombuffer(content, dtype.value).reshape(shape, order=order).copy()
    )


def _storage(content: bytes) -> Any:
    import torch  # here: few files need it

    return torch.load(
        io.BytesIO(content), map_location="cpu", weights_only=True
    )


def _tensor(storage: Any, offset: int, size: Any, stride: Any, *_: Any) -> Any:
    import torch

    count = math.prod(size)
    _expect(count * 8 <= LARGEST_ARRAY, f"a tensor of shape {tuple(size)}")
    tensor = torch.empty(0, dtype=storage.dtype)
    tensor.set_(storage._untyped_storage, offset, tuple(size), tuple(stride))
    return tensor.double().numpy()


def _encode(text: str, _encoding: str) -> bytes:
    return text.encode("latin1")


# Module and name in the pickle, and the object that it gets.
ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): "numpy.ndarray",  # pickles only name the class
    ("numpy", "dtype"): _DType,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("_codecs", "encode"): _encode,
    ("copyreg", "_reconstructor"): copyreg._reconstructor,  # type: ignore[attr-defined]
    ("builtins", "object"): object,
    ("builtins", "set"): set,
    ("chumpy.ch", "Ch"): _Chumpy,
    ("chumpy.reordering", "Select"): _Select,
    ("scipy.sparse.csc", "csc_matrix"): _Sparse,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch.storage", "_load_from_bytes"): _storage,
    ("collections", "OrderedDict"): dict,
}
# Modules that other versions call by another name.
RENAMED = {
    "__builtin__": "builtins",  # in Python 2
    "copy_reg": "copyreg",
    "numpy._core.multiarray": "numpy.core.multiarray",  # in numpy 2
    "numpy._core.numeric": "numpy.core.numeric",
    "scipy.sparse._csc": "scipy.sparse.csc",
}


# -- reading


class _Unpickler(pickle._Unpickler):
    """In Python: a damaged file makes the one in C reserve as much memory as a number names."""

    def find_class(self, module: str, name: str) -> Any:
        # The names of one version stand for those of all.
        source = RENAMED.get(module, module), name
        if source not in ALLOWED:
            raise _Refused(f"{module}.{name}")
        return ALLOWED[source]


def _load(stream: BinaryIO) -> Any:
    # Stand-ins become arrays, alone or as values of a dict.
    content = _Unpickler(stream, encoding="latin1").load()
    if isinstance(content, dict):
        for key, value in content.items():
            if isinstance(value, _Chumpy):
                content[key] = value.array()
    return content.array() if isinstance(content, _Chumpy) else content


@contextmanager
def _as_data_error(path: Path, what: str) -> Iterator[None]:
    """Turns any error inside into one sentence that names the file."""
    try:
        yield
    except FileNotFoundError:
        raise DataError(f"{path} does not exist") from None
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror or error}"
        ) from None
    except _Refused as error:
        # The name in a damaged file may have line breaks.
        name = " ".join(str(error).split())
        raise DataError(
            f"{path} asks for {name}, which is not allowed, since a pickle can run code; nothing "
            "was run: save its content as plain arrays with numpy.savez"
        ) from None
    except Exception as error:
        refuse_empty(path)
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise DataError(
            f"{path} is not a valid {what} ({reason}); export it again"
        ) from None


def read_pickle(path: Path) -> Any:
    """The content of a .pkl file.

    Text and bytes of Python 2 are read as latin1. The values of a dict that are arrays of chumpy or
    sparse matrices become plain arrays.

    Raises:
        DataError: when the file is missing, damaged, or names a class that is not allowed.
    """
    with _as_data_error(path, "pickle"):
        content = path.read_bytes()
    head = content[:JOBLIB_HEAD]
    for magic, make in COMPRESSED.items():
        if content.startswith(magic):
            # Whatever fails here fails again below, with a message.
            with suppress(EOFError, OSError, zlib.error, lzma.LZMAError):
                head = make().decompress(content, JOBLIB_HEAD)
    if b"joblib.numpy_pickle" in head:
        line = FOUR_D_HUMANS if b"global_orient" in head else WHAM
        line = line.format(given=path.name, made=f"{path.stem}.npz")
        raise DataError(
            f"{path} was written by joblib, whose files can run code; nothing was run: if you "
            f'trust it, convert it by python -c "import joblib, numpy; {line}"'
        )
    with _as_data_error(path, "pickle"):
        return _load(io.BytesIO(content))


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
        members = {}
        for info in archive.infolist():
            members[info.filename.removesuffix(".npy")] = info

        # Sizes are checked before anything is unpacked.
        arrays = {}
        for name in members if names is None else members.keys() & set(names):
            size = members[name].file_size
            _expect(
                size <= LARGEST_ARRAY, f"{name} would unpack to {size} bytes"
            )
            array = _read_array(
                io.BytesIO(archive.read(members[name])), objects
            )
            _expect(not np.iscomplexobj(array), f"{name} holds complex numbers")
            arrays[name] = array
        return arrays


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """The named arrays of an npz file, without those that are absent.

    Raises:
        DataError: when the file is missing or no npz, an array is too large, or holds objects.
    """
    return read_npz(path, names, objects=False)


def _read_array(stream: BinaryIO, objects: bool = True) -> Any:
    # Arrays of numbers; numpy refuses arrays of objects after their header.
    try:
        return np.lib.format.read_array(stream, allow_pickle=False)
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
    if not objects:
        raise _Refused("pickled Python objects")

    # The rest of the stream is a pickle. A 0-d array holds one object.
    content = _load(io.BytesIO(stream.read()))
    if isinstance(content, np.ndarray) and content.ndim == 0:
        return content.item()
    return content
