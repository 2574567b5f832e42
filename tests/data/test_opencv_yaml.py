"""OpenCV's YAML: what OpenCV wrote is read as OpenCV reads it; what is damaged is one sentence."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsgan.data.calibration.opencv_yaml import MAX_BYTES, read_storage
from gsgan.utils.errors import DataError

NAMES = ["01", "cam a", "Camera (1)", "1e3", "- x", 'the "left" one', "cam's", "ü"]
HEAD = "%YAML:1.0\n---\n"
MATRIX = "M: !!opencv-matrix\n   rows: 2\n   cols: 1\n   dt: d\n   data: [ 1., -2.5e-3 ]\n"


def matrices() -> dict[str, np.ndarray]:
    rng, found = np.random.default_rng(0), {}
    for i, kind in enumerate((np.float64, np.float32, np.int32) * 5):
        size = rng.integers(1, 15, 2)
        found[f"M_{i}"] = (rng.standard_normal(size) * 10.0 ** rng.integers(0, 8)).astype(kind)
    found["tiny"] = np.array([[1e-300, -5e-324, 0.1 + 0.2]])
    found["odd"] = np.array([[np.inf, -np.inf, np.nan]])
    return found


def test_opencvs_files_are_read_as_opencv_reads_them(tmp_path: Path) -> None:
    path = str(tmp_path / "rig.yml")
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    for key, matrix in matrices().items():
        storage.write(key, matrix)
    storage.write("H_1", 1920)
    storage.writeComment("by hand")
    storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
    for name in NAMES:
        storage.write("", name)
    storage.endWriteStruct()
    storage.release()
    found, again = read_storage(tmp_path / "rig.yml"), cv2.FileStorage(path, cv2.FILE_STORAGE_READ)
    for key in matrices():
        np.testing.assert_array_equal(found.get(key, np.ndarray), again.getNode(key).mat())
    assert found.get("names", list) == NAMES
    assert found.pixels("H_1") == 1920
    assert found.get("absent", list) is None
    assert found.pixels("absent") == 0


@pytest.mark.parametrize("lines", ["\n", "\r\n"])
@pytest.mark.parametrize("head", ["%YAML:1.0\n---\n", "%YAML 1.2\n---\n", "\ufeff%YAML:1.0\n"])
def test_heads_and_ends_of_line(tmp_path: Path, head: str, lines: str) -> None:
    text = head + 'names:\n- "1"\n- 002\n' + MATRIX + "...\n"
    (tmp_path / "a.yml").write_bytes(text.replace("\n", lines).encode())
    found = read_storage(tmp_path / "a.yml")
    assert found.get("names", list) == ["1", "002"]  # unquoted numbers stay the names they are
    np.testing.assert_array_equal(found.get("M", np.ndarray), [[1], [-0.0025]])


NO_MATRIX = "rows x cols numbers in line 3"
DAMAGE = {
    "cut in a list": (HEAD + MATRIX[:-12], "it may be cut off"),
    "cut in a number": (HEAD + MATRIX.replace(", -2.5e-3", ""), NO_MATRIX),
    "no data": (HEAD + MATRIX[: MATRIX.index("   data")], NO_MATRIX),
    "a word": (HEAD + MATRIX.replace("1.,", "one,"), NO_MATRIX),
    "a list in the list": (HEAD + MATRIX.replace("1.,", "[1.],"), NO_MATRIX),
    "many rows": (HEAD + MATRIX.replace("rows: 2", "rows: 2000000000"), NO_MATRIX),
    "negative rows": (HEAD + MATRIX.replace("rows: 2", "rows: -2"), NO_MATRIX),
    "half a row": (HEAD + MATRIX.replace("rows: 2", "rows: 1.5"), NO_MATRIX),
    "no rows": (HEAD + MATRIX.replace("   rows: 2\n", ""), NO_MATRIX),
    "two channels": (HEAD + MATRIX.replace("dt: d", "dt: 2d"), NO_MATRIX),
    "no tag": (HEAD + MATRIX.replace(" !!opencv-matrix", ""), "must be an !!opencv-matrix"),
    "code": (HEAD + "M: !!python/object/apply:os.system [ls]\n", "must be an !!opencv-matrix"),
    "no keys": (HEAD + "- 1\n", "it has no keys"),
    "empty": ("", "it has no keys"),
    "two documents": (HEAD + MATRIX + HEAD + MATRIX, "not readable as OpenCV YAML"),
    "deep": (HEAD + "M: " + "[" * 300, "not readable as OpenCV YAML"),
    "an alias of itself": (HEAD + "M: &a [ *a ]\n", "recursive node"),
    "an escape": (HEAD + 'M: "\\UFFFFFFFF"\n', "not readable as OpenCV YAML"),
    "a nul": (HEAD + "M: \0\n", "not readable as OpenCV YAML"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_one_sentence(tmp_path: Path, name: str) -> None:
    text, message = DAMAGE[name]
    path = tmp_path / "a.yml"
    path.write_text(text)
    with pytest.raises(DataError) as failure:
        read_storage(path).get("M", np.ndarray)
    assert str(path) in str(failure.value)
    assert message in str(failure.value)
    assert "\n" not in str(failure.value)


def test_values_of_another_kind_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.yml"
    path.write_text(HEAD + "names: cam1\nH: tall\n")
    found = read_storage(path)
    with pytest.raises(DataError, match="'names' must be a list of names"):
        found.get("names", list)
    with pytest.raises(DataError, match="'H' must be a number of pixels"):
        found.pixels("H")


def test_size_is_bounded_and_other_bytes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.yml"
    path.write_bytes(b"%YAML:1.0\nx: \xff\n")
    with pytest.raises(DataError, match="not readable as OpenCV YAML"):
        read_storage(path)
    path.write_bytes(b" " * (MAX_BYTES + 1))
    with pytest.raises(DataError, match=r"has \d+ bytes, a calibration at most"):
        read_storage(path)
    with pytest.raises(DataError, match="not readable as OpenCV YAML"):
        read_storage(tmp_path)
