"""OpenCV's YAML: what OpenCV wrote is read as OpenCV reads it; what is damaged is one sentence."""

import numpy as np
import pytest
from writers.easymocap import write_opencv

from gsgan.data.calibration import MAX_YAML_BYTES, read_opencv_yaml
from gsgan.utils.errors import DataError

HEAD = "%YAML:1.0\n---\n"
MATRIX = "M: !!opencv-matrix\n   rows: 2\n   cols: 1\n   dt: d\n   data: [ 1., -2.5e-3 ]\n"


def test_opencvs_files_are_read_as_opencv_reads_them(tmp_path):
    names, rng = ["01", "cam a", "1e3", "ü"], np.random.default_rng(0)
    matrices = {
        f"M_{i}": rng.standard_normal(rng.integers(1, 15, 2)) for i in range(5)
    }
    write_opencv(tmp_path / "rig.yml", names, {**matrices, "H_1": 1920})
    found = read_opencv_yaml(tmp_path / "rig.yml")
    for key, matrix in matrices.items():
        np.testing.assert_array_equal(found[key], matrix)
    assert found["names"] == names
    assert found["H_1"] == "1920"


@pytest.mark.parametrize(
    "head",
    ["%YAML:1.0\r\n---\r\n", "%YAML 1.2\n---\n", "---\n", "\ufeff%YAML:1.0\n"],
)
def test_heads(tmp_path, head):
    (tmp_path / "a.yml").write_bytes(
        (head + "names:\n- 002\n" + MATRIX + "...\n").encode()
    )
    found = read_opencv_yaml(tmp_path / "a.yml")
    assert found["names"] == ["002"]  # unquoted numbers stay the names they are
    np.testing.assert_array_equal(found["M"], [[1], [-0.0025]])


DAMAGE = {
    "cut in a list": HEAD + MATRIX[:-12],
    "cut in a number": HEAD + MATRIX.replace(", -2.5e-3", ""),
    "no data": HEAD + MATRIX[: MATRIX.index("   data")],
    "a word": HEAD + MATRIX.replace("1.,", "one,"),
    "many rows": HEAD + MATRIX.replace("rows: 2", "rows: 2000000000"),
    "code": HEAD + "M: !!python/object/apply:os.system [ls]\n- 1",
    "empty": "",
    "deep": HEAD + "M: " + "[" * 300,
    "an alias of itself": HEAD + "M: &a [ *a ]\n",
    "a nul": HEAD + "M: \0\n",
    "too large": " " * (MAX_YAML_BYTES + 1),
}


@pytest.mark.parametrize("text", DAMAGE.values(), ids=DAMAGE.keys())
def test_damage_is_one_sentence(tmp_path, text):
    path = tmp_path / "a.yml"
    path.write_text(text)
    with pytest.raises(DataError, match="OpenCV YAML") as failure:
        read_opencv_yaml(path)
    assert str(path) in str(failure.value)
    assert "\n" not in str(failure.value)
