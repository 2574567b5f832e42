"""A sample of what scripts/fuzz.py does: every kind of file, damaged and hostile."""

import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "fuzz.py"


def test_damaged_files_are_read_or_refused_and_run_nothing(bare, monkeypatch):
    pytest.importorskip("pose_format")
    pytest.importorskip("safetensors")
    monkeypatch.chdir(SCRIPT.parent)
    script = runpy.run_path(str(SCRIPT))
    table, wrong = script["fuzz"](bare.resolve(), 110)
    assert not wrong
    assert len(table) == 11
    assert sum(found["refused"] for found in table.values()) > 50


def test_the_hook_sees_a_program_and_a_file(tmp_path):
    script = runpy.run_path(str(SCRIPT))
    whole = tmp_path / "a"
    whole.write_bytes(b"1")
    for action in (
        "__import__('os').system('true')",
        f"open({str(tmp_path.parent / 'b')!r}, 'w')",
    ):
        found = script["batch"](
            tmp_path, [(whole, lambda _, a=action: eval(a))], "a", 0, 1
        )
        assert list(found) == ["code"]
    greedy = [(whole, lambda _: bytearray(3 << 30)), (whole, lambda _: b"1")]
    assert list(script["batch"](tmp_path, greedy, "a", 0, 2)) == [
        "memory",
        "read",
    ]
