"""Pickles are read, never run: allowed content comes back whole, the rest is one sentence."""

from __future__ import annotations

import functools
import io
import os
import pickle
import struct
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
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
        assert type(found[key]) is np.ndarray
        assert found[key].dtype == SAMPLE[key].dtype.newbyteorder("=")
        np.testing.assert_array_equal(found[key], SAMPLE[key])
    assert type(found["nested"]["list"][0]) is np.ndarray
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


@pytest.mark.parametrize("module", ["scipy.sparse.{}", "scipy.sparse._{}"])
@pytest.mark.parametrize("kind", ["csc", "csr", "coo"])
def test_sparse_matrices_become_dense_and_sum_their_doubles(tmp_path, kind, module):
    state = {"_shape": (2, 3), "data": np.array([1.0, 2.0, 4.0])}
    if kind == "csc":  # entries (0,0) (0,0) (1,2)
        state |= {"indices": np.array([0, 0, 1]), "indptr": np.array([0, 2, 2, 3])}
    elif kind == "csr":
        state |= {"indices": np.array([0, 0, 2]), "indptr": np.array([0, 2, 3])}
    else:
        state |= {"row": np.array([0, 0, 1]), "col": np.array([0, 0, 2])}
    matrix = python2.Instance(module.format(kind), f"{kind}_matrix", state)
    found = read_pickle(write(tmp_path, python2.dumps(matrix)))
    np.testing.assert_array_equal(found, [[3, 0, 0], [0, 0, 4]])


def test_an_object_array_gives_its_dict(tmp_path):
    content = {"cams": {"K": [np.eye(3)] * 2}, "ims": [{"ims": ["a\\b.jpg"]}]}
    np.save(tmp_path / "annots.npy", np.array(content, dtype=object), allow_pickle=True)
    found = read_npy(tmp_path / "annots.npy")
    np.testing.assert_array_equal(found["cams"]["K"][1], np.eye(3))
    assert found["ims"] == content["ims"]
    several = np.array([{"a": 1}, np.zeros(2), "x"], dtype=object)
    np.save(tmp_path / "several.npy", several, allow_pickle=True)
    assert read_npy(tmp_path / "several.npy")[0] == {"a": 1}
    assert type(read_npy(tmp_path / "several.npy")[1]) is np.ndarray


def test_plain_npy_and_npz(tmp_path):
    np.save(tmp_path / "plain.npy", np.arange(6.0).reshape(2, 3).T)
    found = read_npy(tmp_path / "plain.npy")
    np.testing.assert_array_equal(found, np.arange(6.0).reshape(2, 3).T)
    found[0, 0] = 1  # the caller's own
    np.savez_compressed(tmp_path / "a.npz", poses=np.ones(3), extra=np.array({"a": 1}, object))
    assert read_npz(tmp_path / "a.npz")["extra"] == {"a": 1}
    assert list(read_npz(tmp_path / "a.npz", ["poses", "absent"])) == ["poses"]


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
        f"reduce {p}": (pickle.dumps(Reduced(os.system, command), p), r"(posix|nt)\.system")
        for p in range(6)
    }
    state = pickle.dumps(Reduced(eval, python), 2)[2:-1]
    key = _text("x")
    return found | {
        "eval": (pickle.dumps(Reduced(eval, python), 4), r"builtins\.eval"),
        "python 2 eval": (b"c__builtin__\neval\n(" + _text(python) + b"tR.", r"__builtin__\.eval"),
        "inst": (b"(" + arguments + b"ios\nsystem\n.", r"os\.system"),
        "obj": (b"(cos\nsystem\n" + arguments + b"o.", r"os\.system"),
        "in a list": (pickle.dumps([1, [Reduced(os.system, command)]]), r"system"),
        "in a state": (b"cchumpy.ch\nCh\n)\x81}" + key + state + b"sb.", "eval"),
        "in an array": (pickle.dumps(np.array([Reduced(eval, python)], object)), "eval"),
        "getattr": (b"cbuiltins\ngetattr\n(" + _text("a") + b"tR.", "getattr"),
        "dotted": (b"\x80\x04" + _text("numpy") + _text("ndarray.tofile") + b"\x93.", "tofile"),
        "dotted module": (b"\x80\x04" + _text("numpy.ndarray") + _text("tofile") + b"\x93.", "tof"),
        "numpy.load": (b"cnumpy\nload\n(" + arguments + b"tR.", r"numpy\.load"),
        "partial": (pickle.dumps(functools.partial(os.system, command)), r"functools\.partial"),
        "reconstructor": (
            b"ccopyreg\n_reconstructor\n(csubprocess\nPopen\ncbuiltins\nobject\nNtR.",
            r"subprocess\.Popen",
        ),
        "ext1": (b"\x80\x02\x82\x01.", "EXT1"),
        "ext2": (b"\x80\x02\x83\x01\x00.", "EXT2"),
        "ext4": (b"\x80\x02\x84\x01\x00\x00\x00.", "EXT4"),
        "persid": (b"Pevil\n.", "PERSID"),
        "binpersid": (b"Nq\x00Q.", "BINPERSID"),
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

ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"


def dtype(spec: bytes, fields: bytes = b"NNN") -> bytes:
    return (
        b"cnumpy\ndtype\n(S'" + spec + b"'\nI0\nI1\ntR(I3\nS'<'\n" + fields + b"I-1\nI-1\nI63\ntb"
    )


def array(shape: bytes, kind: bytes, content: bytes) -> bytes:
    return ARRAY + b"(I1\n(" + shape + b"t" + kind + b"I0\n" + content + b"tb."


def sparse(kind: str, **state: object) -> bytes:
    return python2.dumps(python2.Instance(f"scipy.sparse.{kind}", f"{kind}_matrix", state))


TRILLION = b"I1000000000000\n"
CHUMPY, SET, OBJECT = b"cchumpy.ch\nCh\n", b"cbuiltins\nset\n", b"cbuiltins\nobject\n"
ENCODE, RECONSTRUCTOR = b"c_codecs\nencode\n", b"ccopyreg\n_reconstructor\n"
NONE = np.zeros(0, int)
MISUSES = {
    "a shape without its bytes": (array(TRILLION, dtype(b"f8"), b"S''\n"), "shape and bytes"),
    "one object for many": (array(b"I9\n", dtype(b"O8"), b"(lNa"), "shape and bytes"),
    "bytes as objects": (array(b"I1\n", dtype(b"O8"), b"S'12345678'\n"), "no list of them"),
    "a record type": (array(b"I1\n", dtype(b"V8"), b"S'12345678'\n"), "array type 'V8'"),
    "fields in a number": (
        array(b"I1\n", dtype(b"f8", b"N(S'a'\nt(d"), b"S'12345678'\n"),
        "record arrays",
    ),
    "a type without size": (array(TRILLION, dtype(b"S0"), b"S''\n"), "array type 'S0'"),
    "a negative shape": (
        array(b"I-1\nI-1\n", dtype(b"f8"), b"S'12345678'\n"),
        "shape and bytes",
    ),
    "several types in one": (dtype(b"f8,O") + b".", "array type 'f8,O'"),
    "an enormous base": (ARRAY.replace(b"I0\n", TRILLION) + b".", "unknown way"),
    "another class of array": (ARRAY.replace(b"cnumpy\nndarray\n", SET) + b".", "unknown way"),
    "a new array outright": (b"cnumpy\nndarray\n(" + TRILLION + b"t\x81.", "NEWOBJ"),
    "a codec that runs": (ENCODE + b"(V123\nVzlib\ntR.", "encodes text oddly"),
    "a state for a function": (ENCODE + b"(N(dS'__defaults__'\nNstb.", "function a state"),
    "a state for a stand-in class": (CHUMPY + b"(dS'array'\nNsb.", "missing 1 required"),
    "slots for a stand-in class": (CHUMPY + b"(N(dS'array'\nNstb.", "missing 1 required"),
    "slots for a stand-in": (CHUMPY + b")\x81(N(dS'array'\nNstb.", "broken state"),
    "a state for a built-in": (SET + b"(dS'add'\nNsb.", "does not support"),
    "slots for a built-in": (SET + b"(N(dS'add'\nNstb.", "immutable"),
    "a reconstructor with a state": (
        RECONSTRUCTOR + b"(" + CHUMPY + OBJECT + b"I1\ntR.",
        "unknown way",
    ),
    "a reconstructor of a set": (RECONSTRUCTOR + b"(" + SET + OBJECT + b"NtR.", "unknown way"),
    "a stand-in without its array": (
        python2.dumps(python2.Instance("chumpy.ch", "Ch", {"y": 1})),
        "it has no 'x'",
    ),
    "a sparse matrix out of bounds": (
        sparse("csc", _shape=(2, 2), data=np.ones(1), indices=NONE + 7, indptr=NONE),
        "misses entries",
    ),
    "a sparse row out of bounds": (
        sparse("coo", _shape=(2, 2), data=np.ones(1), row=np.array([7]), col=np.array([0])),
        "out of bounds",
    ),
    "a sparse row from the end": (
        sparse("coo", _shape=(2, 2), data=np.ones(1), row=np.array([-1]), col=np.array([0])),
        "negative",
    ),
    "a sparse matrix of a petabyte": (
        sparse("coo", _shape=(10**8, 10**7), data=np.ones(0), row=NONE, col=NONE),
        "larger than the file",
    ),
    "a selection from itself": (
        b"cchumpy.reordering\nSelect\n)\x81p0\n(dS'a'\ng0\nsS'idxs'\ng0\nsb.",
        "recursion",
    ),
    "a memo slot far out": (b"Nr\xff\xff\xff\x7f.", "LONG_BINPUT"),
    "a memo slot far out in text": (b"Np99999999999\n.", "PUT"),
    "bytes that are not there": (b"\x8e" + struct.pack("<Q", 10**12) + b"x.", "ends early"),
    "a bytearray that is not there": (b"\x96" + struct.pack("<Q", 10**12) + b"x.", "ends early"),
    "text of 2^64 - 1 bytes": (b"\x8d" + b"\xff" * 8 + b"x.", "ends early"),
    "a frame that is not there": (b"\x80\x04\x95" + struct.pack("<Q", 10**12) + b"N.", "FRAME"),
    "no stop": (b"(lp0\n", "ends early"),
    "nothing": (b"", "ends early"),
    "an empty stack": (b".", "underflow"),
    "no pickle": (b"\xff\xfe hello", "no pickle"),
    "an unhashable key": (b"(d(dNs.", "unhashable"),
    "a web page": (b"<!DOCTYPE html><html>not found</html>", "no pickle"),
}


@pytest.mark.parametrize("name", list(MISUSES))
def test_allowed_names_cannot_be_misused(tmp_path, name):
    refused(tmp_path, *MISUSES[name])


def test_shared_bytes_do_not_grow_without_bound(tmp_path):
    text = "a" * 2_000_000
    shared = b"V" + text.encode() + b"\np1\n0"
    one = b"c_codecs\nencode\n(g1\nVlatin1\ntRa"
    refused(tmp_path, shared + b"(l" + 400 * one + b".", "larger than the file")


def nested(pair: bytes, levels: int) -> bytes:
    """A tuple in a tuple, each twice: 2^levels entries by following every reference."""
    return b"\x80\x02)" + pair * levels


def lists_in_lists(levels: int, each: int = 2) -> bytes:
    """Lists that hold the one before them several times over."""
    parts = [b"(lp0\nI1\na"]
    parts += [b"(lp%d\n" % i + each * (b"g%d\na" % (i - 1)) for i in range(1, levels)]
    return b"".join(parts) + b"."


def selections(levels: int) -> bytes:
    """chumpy's selections, the array and the indices of each being the one before."""
    first = python2.dumps(np.zeros(1, int))[:-1] + b"q\x00"
    step = b"cchumpy.reordering\nSelect\n)\x81(dS'a'\nh%csS'idxs'\nh%csbq%c"
    return first + b"".join(step % (i, i, i + 1) for i in range(levels)) + b"."


ENDLESS = {
    "a key of 2^60 entries": (b"\x80\x02}" + nested(b"2\x86", 60)[2:] + b"Ns.", "tuple of more"),
    "a key that overruns the stack": (
        b"\x80\x02}" + nested(b"\x85", 10**6)[2:] + b"Ns.",
        "tuple of more",
    ),
    "such a key by the memo": (
        b"\x80\x04})" + b"".join(b"\x94h%c\x86" % i for i in range(60)) + b"Ns.",
        "tuple of more",
    ),
    "such a key down to a mark": (
        b"}(tp0\n" + b"".join(b"(g%d\ng%d\ntp%d\n" % (i, i, i + 1) for i in range(60)) + b"Ns.",
        "tuple of more",
    ),
    "lists of 2^64 paths": (lists_in_lists(64), "unfolds"),
    "lists in a tuple in lists": (lists_in_lists(30, 10), "unfolds"),
    "100 000 lists in one another": (b"(l" * 100_000 + b"a" * 99_999 + b".", "unfolds"),
    "a list that holds itself": (b"(lp0\ng0\na.", "holds itself"),
    "an array type of 2^60 entries": (
        b"cnumpy\ndtype\n(" + lists_in_lists(60)[:-1] + b"I0\nI1\ntR.",
        "array type list",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", list(ENDLESS))
def test_what_is_endless_once_unfolded_is_refused_at_once(tmp_path, name):
    start = time.perf_counter()
    refused(tmp_path, *ENDLESS[name])
    assert time.perf_counter() - start < 20


def test_selections_of_selections_are_found_once(tmp_path):
    assert read_pickle(write(tmp_path, selections(100))).tolist() == [0]


def test_shared_lists_and_tuples_of_honest_files_are_read(tmp_path):
    shape, row = (24, 3), list(range(1000))
    content = {"shapes": [shape] * 5000, (1, (2, 3)): [row] * 500}
    assert read_pickle(write(tmp_path, pickle.dumps(content))) == content


# --- damage ------------------------------------------------------------------------------------


def header(shape: object, descr: str = "<f8", major: int = 1) -> bytes:
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY" + bytes([major, 0]) + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize(
    "content",
    [
        header((10**12,)) + bytes(64),
        header((10**12, 10**12)),
        header((4,)) + bytes(31),
        header((4,)) + bytes(33),
        header((-4,)) + bytes(32),
        header((10**12,), "|S0"),
        header((), "|O") + b"N.",
        header((10**12,), "|O") + pickle.dumps(np.array({}, object)),
        header("(((((", "<f8"),
        header("'a'"),
        header((4,), "<f8", major=9) + bytes(32),
        b"\x93NUMPY",
        b"",
        b"not an array",
    ],
    ids=lambda content: content[:90].decode("latin1").strip()[-45:],
)
def test_a_damaged_npy_is_one_sentence(tmp_path, content):
    path = write(tmp_path, content, "a.npy")
    with pytest.raises(DataError, match=r"a\.npy is not a whole \.npy file") as caught:
        read_npy(path)
    assert "\n" not in str(caught.value)


def test_a_damaged_npz_is_one_sentence(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("poses.npy", header((10**12,)))
    with pytest.raises(DataError, match="promises 8000000000000 bytes"):
        read_npz(tmp_path / "a.npz")
    whole = (tmp_path / "a.npz").read_bytes()
    with pytest.raises(DataError, match=r"not a whole npz file"):
        read_npz(write(tmp_path, whole[:-30], "cut.npz"))


@pytest.mark.parametrize("read", [read_pickle, read_npy, read_npz])
def test_a_missing_file_and_a_folder(tmp_path, read):
    with pytest.raises(DataError, match="does not exist"):
        read(tmp_path / "absent")
    with pytest.raises(DataError, match="cannot be read"):
        read(tmp_path)


def _damaged(content: bytes, rng: np.random.Generator) -> bytes:
    if rng.random() < 0.3:
        return content[: rng.integers(len(content))]
    changed = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        changed[rng.integers(len(changed))] = rng.integers(256)
    return bytes(changed)


@pytest.mark.parametrize("kind", ["protocol 0", "protocol 2", "protocol 4", "npy", "npz"])
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
    for _ in range(250):
        try:
            reader(write(tmp_path, _damaged(stream.getvalue(), rng)))
        except DataError as error:
            sentences.append(str(error))
    assert len(sentences) > 60
    assert all("file.pkl" in s and "\n" not in s for s in sentences)
