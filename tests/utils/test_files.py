"""Text files as people leave them after an editor."""

import json

import pytest

from gsgan.data.calibration import read_calibration
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_json_value, with_decimal_points

COMMENTED = """// rig of the studio, see http://studio.example
{ /* all
     cameras */
  "a//b": [1, 2,], "c": "x, ]", // last
  "d": "\\\\\\"/*",
}
"""


def test_json_may_have_comments_and_commas_after_the_last_entry(tmp_path):
    path = tmp_path / "a.json"
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        path.write_text(COMMENTED, encoding=encoding)
        expected = {"a//b": [1, 2], "c": "x, ]", "d": '\\"/*'}
        assert read_json_value(path) == expected


@pytest.mark.parametrize("text", ['{"a": 1', "{'a': 1}", '{"a": 1,, }'])
def test_other_damage_of_json_is_named_with_its_line(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text("// one\n\n" + text)
    with pytest.raises(DataError, match=r"not valid JSON: .* line 3"):
        read_json_value(path)


def test_one_value_in_each_line_is_named(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": 1}\n{"a": 2}\n')
    with pytest.raises(DataError, match="several values follow each other"):
        read_json_value(path)


def test_a_calibration_below_a_comment_is_known(tmp_path):
    camera = {"K": [[9, 0, 5], [0, 9, 5], [0, 0, 1]], "t": [0, 0, 3]}
    camera |= {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "size": [10, 10]}
    path = tmp_path / "cameras.json"
    path.write_text("// metres\n" + json.dumps({"a": camera}))
    assert list(read_calibration(path).cameras) == ["a"]

    # Cameras of another program are named by what they have.
    path.write_text(json.dumps({"cameras": {"a": camera}}))
    with pytest.raises(DataError, match=r"camera cameras: .* found a$"):
        read_calibration(path)
    path.write_text(json.dumps({"a": {"fx": 9, "R": 1}}))
    with pytest.raises(DataError, match=r"found fx, R$"):
        read_calibration(path)


def test_only_numbers_without_points_have_decimal_commas():
    assert with_decimal_points("-0,5 1,25e-05 a,1 1,2,3") == (
        "-0.5 1.25e-05 a,1 1,2,3"
    )
    assert with_decimal_points("0,5 1.5") == "0,5 1.5"
