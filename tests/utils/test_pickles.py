"""Pickles are read, never run: allowed content comes back whole, the rest is one sentence."""

import bz2
import gzip
import io
import lzma
import os
import pickle
import struct
import zipfile
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from make import damaged
from writers import python2

from gsgan.utils.errors import DataError
from gsgan.utils.pickles import read_npy, read_npz, read_pickle

SAMPLE = {
    "poses": np.arange(72.0).reshape(1, 72),
    "counts": np.arange(6, dtype=np.uint32).reshape(2, 3),
    "names": np.array(["a", "bc"]),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big_endian": np.arange(3, dtype=">i4"),
    "nested": {"list": [np.ones(2), "text", None, 1.5], "tuple": (1, 2)},
    "scalar": np.float64(0.25),
    "arrays": (np.ones(2), np.zeros(1)),
    "kinds": {1, 2},
}


def write(tmp_path: Path, content: bytes, name: str = "file.pkl") -> Path:
    path = tmp_path / name
    path.write_bytes(content)
    return path


def refused(tmp_path: Path, content: bytes, match: str | None = None) -> None:
    path = write(tmp_path, content)
    with pytest.raises(DataError, match=match) as caught:
        read_pickle(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("protocol", range(6))
def test_plain_content_comes_back_as_it_was(tmp_path, protocol):
    found = read_pickle(write(tmp_path, pickle.dumps(SAMPLE, protocol)))
    assert found.keys() == SAMPLE.keys()
    for key in ("poses", "counts", "names", "fortran", "big_endian"):
        np.testing.assert_array_equal(found[key], SAMPLE[key])
    np.testing.assert_array_equal(found["nested"]["list"][0], np.ones(2))
    assert found["nested"]["tuple"] == (1, 2)
    assert found["scalar"] == 0.25
    assert found["kinds"] == {1, 2}


@pytest.mark.parametrize("protocol", [0, 2])
def test_python_2_pickles_with_chumpy_and_scipy(tmp_path, protocol):
    dense = np.array([[0, 1.5, 0], [2.0, 0, -3.0]])
    values = np.random.default_rng(0).standard_normal((3, 4))
    content = {
        "plain": values,
        "chumpy": python2.chumpy(values),
        "select": python2.chumpy_select(values, (4, 3)),
        "csc": python2.csc(dense),
        "accent": "\xe9",
    }
    found = read_pickle(write(tmp_path, python2.dumps(content, protocol)))
    np.testing.assert_array_equal(found["plain"], values)
    np.testing.assert_array_equal(found["chumpy"], values)
    np.testing.assert_array_equal(found["select"], values.reshape(4, 3))
    np.testing.assert_array_equal(found["csc"], dense)
    assert found["accent"] == "\xe9"


def test_an_object_array_gives_its_dict(tmp_path):
    content = {"cams": {"K": [np.eye(3)] * 2}, "ims": [{"ims": ["a\\b.jpg"]}]}
    np.save(
        tmp_path / "annots.npy",
        np.array(content, dtype=object),
        allow_pickle=True,
    )
    found = read_npy(tmp_path / "annots.npy")
    np.testing.assert_array_equal(found["cams"]["K"][1], np.eye(3))
    assert found["ims"] == content["ims"]
    several = np.array([{"a": 1}, np.zeros(2), "x"], dtype=object)
    np.save(tmp_path / "several.npy", several, allow_pickle=True)
    assert read_npy(tmp_path / "several.npy")[0] == {"a": 1}
    np.testing.assert_array_equal(
        read_npy(tmp_path / "several.npy")[1], np.zeros(2)
    )


def test_plain_npy_and_npz(tmp_path):
    np.save(tmp_path / "plain.npy", np.arange(6.0).reshape(2, 3).T)
    found = read_npy(tmp_path / "plain.npy")
    np.testing.assert_array_equal(found, np.arange(6.0).reshape(2, 3).T)
    found[0, 0] = 1  # the caller's own
    np.savez_compressed(
        tmp_path / "a.npz", poses=np.ones(3), extra=np.array({"a": 1}, object)
    )
    assert read_npz(tmp_path / "a.npz")["extra"] == {"a": 1}
    assert list(read_npz(tmp_path / "a.npz", ["poses", "absent"])) == ["poses"]


def test_complex_numbers_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", p=np.ones(3, complex))
    with pytest.raises(DataError, match=r"a\.npz.*p holds complex numbers"):
        read_npz(tmp_path / "a.npz")


# --- what must not run -------------------------------------------------------------------------


class Reduced:
    """Pickles as a call of any function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def _text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def attacks(marker: Path) -> dict[str, tuple[bytes, str]]:
    command = f"touch {marker}"
    python = f"open({str(marker)!r}, 'w')"
    arguments = _text(command)
    found = {
        f"reduce {p}": (
            pickle.dumps(Reduced(os.system, command), p),
            r"(posix|nt)\.system",
        )
        for p in range(6)
    }
    state = pickle.dumps(Reduced(eval, python), 2)[2:-1]
    key = _text("x")
    return found | {
        "eval": (pickle.dumps(Reduced(eval, python), 4), r"builtins\.eval"),
        "inst": (b"(" + arguments + b"ios\nsystem\n.", r"os\.system"),
        "in a list": (pickle.dumps([1, [Reduced(os.system, command)]]), r"system"),
        "in a state": (b"cchumpy.ch\nCh\n)\x81}" + key + state + b"sb.", "eval"),
        "in an array": (pickle.dumps(np.array([Reduced(eval, python)], object)), "eval"),
        "getattr": (b"cbuiltins\ngetattr\n(" + _text("a") + b"tR.", "getattr"),
        "dotted": (b"\x80\x04" + _text("numpy") + _text("ndarray.tofile") + b"\x93.", "tofile"),
        "reconstructor": (
            b"ccopyreg\n_reconstructor\n(csubprocess\nPopen\ncbuiltins\nobject\nNtR.",
            r"subprocess\.Popen",
        ),
        "extension": (b"\x80\x02\x82\x01.", "unregistered extension"),
        "persistent id": (b"Pevil\n.", "persistent"),
    }  # fmt: skip


@pytest.mark.parametrize("name", list(attacks(Path("x"))))
def test_a_malicious_pickle_is_refused_by_name_and_nothing_runs(tmp_path, name):
    content, match = attacks(tmp_path / "ran")[name]
    refused(tmp_path, content, match)
    assert not (tmp_path / "ran").exists()
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "|O", "fortran_order": False, "shape": ()}
    )
    with pytest.raises(DataError, match=match):
        read_npy(write(tmp_path, header.getvalue() + content, "a.npy"))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", header.getvalue() + content)
    with pytest.raises(DataError, match=match):
        read_npz(tmp_path / "a.npz")
    assert not (tmp_path / "ran").exists()


def test_the_attacks_would_run_in_the_plain_unpickler(tmp_path):
    """Else the test above proves nothing."""
    pickle.loads(attacks(tmp_path / "ran")["reduce 4"][0])
    assert (tmp_path / "ran").exists()


# --- allowed names, used to do harm ------------------------------------------------------------

ARRAY = (
    b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
)


def dtype(spec: bytes) -> bytes:
    return (
        b"cnumpy\ndtype\n(S'"
        + spec
        + b"'\nI0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI63\ntb"
    )


def array(shape: bytes, kind: bytes, content: bytes) -> bytes:
    return ARRAY + b"(I1\n(" + shape + b"t" + kind + b"I0\n" + content + b"tb."


def sparse(**state: object) -> bytes:
    return python2.dumps(
        python2.Instance("scipy.sparse.csc", "csc_matrix", state)
    )


CHUMPY, ENCODE = b"cchumpy.ch\nCh\n", b"c_codecs\nencode\n"
NONE = np.zeros(0, int)
MISUSES = {
    "a shape without its bytes": (
        array(b"I1000000000000\n", dtype(b"f8"), b"S''\n"),
        "other con",
    ),
    "one object for many": (
        array(b"I9\n", dtype(b"O8"), b"(lNa"),
        "other content",
    ),
    "bytes as objects": (
        array(b"I1\n", dtype(b"O8"), b"S'12345678'\n"),
        "no list of them",
    ),
    "a negative shape": (
        array(b"I-1\nI-1\n", dtype(b"f8"), b"S'12345678'\n"),
        "other content",
    ),
    "a record type": (
        array(b"I1\n", dtype(b"V8"), b"S'12345678'\n"),
        "type 'V8'",
    ),
    "several types in one": (dtype(b"f8,O") + b".", "type 'f8,O'"),
    "a new array outright": (b"cnumpy\nndarray\n(I9\ntR.", "not callable"),
    "code for a function": (
        ENCODE + b"(N(dS'__code__'\nNstb.",
        "__code__ must be set",
    ),
    "a state for a stand-in class": (
        CHUMPY + b"(N(dS'array'\nNstb.",
        "missing 1 required",
    ),
    "a stand-in without its array": (
        python2.dumps(python2.Instance("chumpy.ch", "Ch", {"y": 1})),
        "valid pickle .'x'",
    ),
    "a sparse row out of bounds": (
        sparse(
            _shape=(2, 1),
            data=np.ones(1),
            indices=NONE + 7,
            indptr=np.array([0, 1]),
        ),
        "ind",
    ),
    "a sparse matrix of a petabyte": (
        sparse(
            _shape=(10**8, 10**7), data=np.ones(0), indices=NONE, indptr=NONE
        ),
        "sparse matrix of shape",
    ),
    "bytes that are not there": (
        b"\x8e" + struct.pack("<Q", 10**12) + b"x.",
        "EOFError",
    ),
    "nothing": (b"", "is empty"),
    "a web page": (b"<!DOCTYPE html><html>not found</html>", "valid pickle"),
}


@pytest.mark.parametrize("name", list(MISUSES))
def test_allowed_names_cannot_be_misused(tmp_path, name):
    refused(tmp_path, *MISUSES[name])


# --- damage ------------------------------------------------------------------------------------


@pytest.mark.parametrize("read", [read_pickle, read_npy, read_npz])
def test_a_missing_file_and_a_folder(tmp_path, read):
    with pytest.raises(DataError, match="does not exist"):
        read(tmp_path / "absent")
    with pytest.raises(DataError, match="cannot be read"):
        read(tmp_path)


@pytest.mark.parametrize(
    "kind", ["protocol 0", "protocol 2", "protocol 4", "npy", "npz"]
)
def test_damage_is_read_or_refused_and_nothing_else(tmp_path, kind):
    smpl_like = {
        "v": np.arange(6.0),
        "s": python2.chumpy(np.ones((2, 2))),
        "J": python2.csc(np.eye(3)),
    }
    plain = {"poses": np.zeros((1, 72)), "list": [np.eye(2), "x", 1]}
    stream, reader = io.BytesIO(), read_pickle
    if kind == "protocol 4":
        stream.write(pickle.dumps(plain, 4))
    elif kind == "npy":
        np.save(stream, np.array(plain, object), allow_pickle=True)
        reader = read_npy
    elif kind == "npz":
        np.savez(stream, poses=np.zeros(5), extra=np.array(plain, object))
        reader = read_npz
    else:
        stream.write(python2.dumps(smpl_like, int(kind[-1])))
    rng, sentences = np.random.default_rng(0), []
    for _ in range(100):
        try:
            reader(write(tmp_path, damaged(stream.getvalue(), rng)))
        except DataError as error:
            sentences.append(str(error))
    assert len(sentences) > 25
    assert all("file.pkl" in s and "\n" not in s for s in sentences)


@pytest.mark.parametrize(
    "squeeze",
    [
        bytes,
        zlib.compress,
        gzip.compress,
        bz2.compress,
        lzma.compress,
        partial(lzma.compress, format=lzma.FORMAT_ALONE),
    ],
)
@pytest.mark.parametrize(
    ("key", "line"), [(b"global_orient", "'smpl'"), (b"pose", "[0]")]
)
def test_files_of_joblib_are_named_with_the_line_that_converts_them(
    tmp_path, squeeze, key, line
):
    content = b"\x80\x04}\x94\x8c" + key + b"\x8c\x13joblib.numpy_pickle\x94"
    path = tmp_path / "wham.pkl"
    path.write_bytes(squeeze(content))
    with pytest.raises(DataError, match="written by joblib") as caught:
        read_pickle(path)
    assert line in str(caught.value)
    assert "savez('wham.npz'" in str(caught.value)
