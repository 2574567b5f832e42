"""Tables: the floor and the marks always show, None is n/a, JSON is strict."""

from __future__ import annotations

import json

from rich.console import Console

from gsgan.metrics.evaluation import METRICS, empty_split
from gsgan.metrics.tables import markdown, notes, print_table, write_results


def results(marks=("perceptual loss: stand-in",)):
    scores = {
        "psnr": 30.123, "psnr_person": 28.0, "high_frequencies": 0.9, "ssim": 0.98,
        "lpips": None, "lpips_reason": "no weights", "edge_f1": 0.5, "miou": 0.9,
        "images": 3, "marks": list(marks),
    }  # fmt: skip
    split = {"full": dict(scores), "splat": dict(scores), "floor": dict(scores)}
    return {"novel_view": empty_split("no camera is held out", list(marks)), "novel_pose": split}


def test_every_table_shows_floor_mark_and_reason(tmp_path):
    console = Console(record=True, width=140)
    print_table(results(), console, "run")
    for text in (console.export_text(), markdown(results(), "run")):
        assert "floor" in text
        assert "marked: perceptual loss: stand-in" in text
        assert "lpips n/a: no weights" in text
        assert "novel_view: no camera is held out" in text
        assert "30.12" in text


def test_metrics_json_has_the_promised_shape(tmp_path):
    write_results(results(), tmp_path, "run")
    stored = json.loads((tmp_path / "metrics.json").read_text())
    assert set(stored) == {"novel_view", "novel_pose"}
    for split in stored.values():
        assert {"full", "splat", "floor"} <= set(split)
        for scores in split.values():
            for metric in METRICS:
                assert metric in scores
                assert scores[metric] is not None or scores[f"{metric}_reason"]
    assert not list(tmp_path.glob("*.part"))


def test_notes_say_each_thing_once():
    said = notes(results())
    assert len(said) == len(set(said)) == 3
