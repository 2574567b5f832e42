"""The command: report, JSON, exit code; and the real capture's findings."""

import base64
import json
import re
import sys

import cv2
import numpy as np
import pytest
from make import edit_json

FEW = ("sampling.images=16", "sampling.shown=2")


@pytest.fixture
def command(tmp_path, monkeypatch, capfd):
    """Runs ``python -m gsgan.check`` in this process: (exit code, output, report's text)."""

    def run(*args: str, report: str = "check.html") -> tuple[int, str, str]:
        from gsgan.check.__main__ import main

        work = tmp_path / "work"
        work.mkdir(exist_ok=True)
        monkeypatch.chdir(work)
        monkeypatch.setenv("COLUMNS", "160")
        arguments = [f"report={report}", *args]
        monkeypatch.setattr(sys, "argv", ["gsgan.check", *arguments])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
        output = "".join(capfd.readouterr())
        written = work / report
        return code, output, written.read_text() if written.is_file() else ""

    return run


def test_a_good_capture_passes_and_leaves_a_report(good, command, tmp_path):
    code, output, page = command(
        f"data.root={good}", "limits.limb_share=2", *FEW
    )
    assert code == 0
    assert "nothing wrong was found" in output
    assert sorted(path.name for path in (tmp_path / "work").iterdir()) == [
        "check.html",
        "check.json",
    ]
    assert "nothing wrong was found" in page
    assert "<script" not in page
    assert "http" not in page
    strips = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    assert len(strips) == 4  # one per camera
    strip = cv2.imdecode(
        np.frombuffer(base64.b64decode(strips[0]), np.uint8), 1
    )
    assert strip.shape == (360 + 18, 270 + 4 + 270, 3)
    for camera in ("cam00", "cam01", "cam02", "cam03"):
        assert f"camera {camera}" in page
    numbers = json.loads((tmp_path / "work" / "check.json").read_text())
    assert numbers["errors"] == 0
    assert numbers["cameras"]["cam00"]["inside"] == 1


def test_something_wrong_ends_with_1(copy, command, tmp_path):
    def exchange(cameras):
        for key in "Rt":
            one, other = cameras["cam00"][key], cameras["cam01"][key]
            cameras["cam00"][key], cameras["cam01"][key] = other, one

    edit_json(copy / "cameras.json", exchange)
    code, output, page = command(f"data.root={copy}", *FEW)
    assert code == 1
    assert "cameras cam00 and cam01 look exchanged" in " ".join(output.split())
    assert "cameras cam00 and cam01 look exchanged" in page
    assert (
        json.loads((tmp_path / "work" / "check.json").read_text())["errors"]
        == 1
    )


@pytest.mark.parametrize(("strict", "ends"), [("false", 0), ("true", 1)])
def test_warnings_end_with_1_where_strict(
    good, command, tmp_path, strict, ends
):
    # at the usual limit the little man's forearm is a warning
    code, *_ = command(f"data.root={good}", f"strict={strict}", *FEW)
    numbers = json.loads((tmp_path / "work" / "check.json").read_text())
    assert numbers["errors"] == 0
    assert numbers["warnings"] > 0
    assert code == ends


def test_names_from_the_data_are_escaped(copy, command):
    (copy / "images" / "cam00").rename(copy / "images" / "<b>&")
    code, _, page = command(f"data.root={copy}", *FEW)
    assert code == 1
    assert "&lt;b&gt;&amp;" in page
    assert "<b>" not in page


def test_a_root_that_is_not_set_is_one_sentence(command):
    code, output, page = command()
    assert code == 1
    assert output.count("\n") == 1
    assert "data.root is not set" in output
    assert page == ""


def test_a_report_that_cannot_be_written_is_reported(good, command, tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "taken").write_text("")
    code, output, _ = command(
        f"data.root={good}", *FEW, report="taken/check.html"
    )
    assert code == 1
    assert "taken/check.html cannot be written" in " ".join(output.split())
