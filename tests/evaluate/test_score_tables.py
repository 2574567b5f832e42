"""Tables: the floor, the marks and what was scored always show, None is n/a, JSON is strict."""

import json

import pandas as pd
import pytest
from rich.console import Console

from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.files import (
    HEADER,
    SHOWN,
    Scored,
    markdown,
    notes,
    print_table,
    rows,
    write_scored,
)
from gsgan.evaluate.predictions import Preparation
from gsgan.evaluate.scores import Scorer, empty, no_scores
from gsgan.metrics.names import BOX_METRICS, METRICS

FACTS = {
    "method": "gsgan", "model": "wo_seg", "protocol": "zju_gauhuman", "seed": 3,
    "data": {"name": "zju_mocap", "root": "my_377", "fingerprint": "0123456789ab"},
    "commit": "abc", "dirty": True,
}  # fmt: skip


def results(marks=("perceptual loss: stand-in",), boxes=None):
    scores = {
        "psnr": 30.123, "psnr_person": 28.0, "psnr_inside": 31.0, "ssim": 0.98,
        "high_frequencies": 0.9, "ssim_person": 0.9, "flicker": 0.01, "warped_flicker": 0.02,
        "psnr_person_shifted": 28.5, "area_outline": 0.2, "error_outline": 0.5,
        "area_trunk": 0.5, "error_trunk": 0.2, "area_limbs": 0.3, "error_limbs": 0.3,
        "lpips_input": "[-1,1]", "lpips_alex": 0.01, "lpips_alex_person": 0.02,
        "lpips_vgg": None, "lpips_vgg_reason": "left out by lpips.nets",
        "lpips_vgg_person": None, "lpips_vgg_person_reason": "left out by lpips.nets",
        "edge_f1_person": 0.5,
        "edge_ratio_person": 1.2, "edge_f1": 0.5, "edge_ratio": 1.25, "miou": 0.9,
        "miou_with_background": 0.95,
        "images": 3, "marks": list(marks), "boxes": boxes, "psnr_over_poses": 1.26,
    }  # fmt: skip
    held = {
        "psnr_hands": 24.5,
        "ssim_hands": 0.9,
        "psnr_mouth": 26.25,
        "ssim_mouth": 0.92,
    }
    scores |= held if boxes else no_scores(BOX_METRICS, "no hands")
    scores["cameras"] = {"cam07": dict.fromkeys(METRICS) | {"psnr": 29.5}}
    split = {"full": dict(scores), "splat": dict(scores), "floor": dict(scores)}
    scorer = Scorer(Preparation(MetricVariants(), None), marks=list(marks))
    unscored = {name: empty("no camera is held out", scorer) for name in split}
    return {"novel_view": unscored, "novel_pose": split}


def test_every_table_shows_floor_mark_reason_and_what_was_scored():
    console = Console(record=True, width=140)
    print_table(results(), FACTS, console)
    for text in (console.export_text(), markdown(results(), FACTS)):
        assert "floor" in text
        assert "marked: perceptual loss: stand-in" in text
        assert "lpips_vgg, lpips_vgg_person n/a: left out by lpips.nets" in text
        assert "LPIPS' networks get [-1,1]" in text
        assert "psnr_mouth, ssim_mouth n/a: no hands" in text
        assert "novel_view: no camera is held out" in text
        assert "30.12" in text
        for said in (
            "protocol zju_gauhuman",
            "my_377, 0123456789ab",
            "seed 3",
            "commit abc",
        ):
            assert said in text
        assert "changed since" in text


@pytest.mark.parametrize("boxes", [None, "hands: their landmarks"])
def test_the_table_fits_a_hundred_columns(boxes):
    console = Console(record=True, width=100)
    print_table(results(boxes=boxes), FACTS, console)
    text = console.export_text()
    assert "…" not in text
    assert text.count("mIoU") == 1
    for said in ("hands ↑", "24.50", "boxes: hands: their landmarks"):
        assert (said in text) == (boxes is not None)


@pytest.mark.parametrize("boxes", [None, "hands: their landmarks"])
def test_every_table_of_the_page_fits_a_hundred_characters(boxes):
    text = markdown(results(boxes=boxes), FACTS)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert max(map(len, lines)) <= 100
    first, _, later = text.partition("## All metrics")
    assert "| PSNR ↑ | in box ↑ | LPIPS-Alex ↓ | SSIM ↑ | mIoU ↑ |" in first
    assert "LPIPS-VGG" not in first.replace("LPIPS' networks", "")
    assert "| PSNR dB in box, shifted ↑ | 28.50 | 28.50 | 28.50 |" in later


def test_the_deviation_over_poses_has_a_row_below_each_image():
    split = results()["novel_pose"]
    lines = list(rows(split, ["psnr", "ssim"]))
    assert lines[1] == ["  ± over poses", "1.26", "n/a"]
    assert len(lines) == 2 * len(split)
    assert any(note.startswith("± over poses") for note in notes(results()))


def test_cameras_have_rows_where_asked_for():
    split = results()["novel_pose"]
    cameras = list(rows(split, SHOWN, cameras=True))
    assert len(cameras) == 2 * len(split)  # one camera in three variants
    assert cameras[1][:2] == ["  cam07", "29.50"]


def test_metrics_json_has_the_promised_shape(tmp_path):
    write_scored(
        Scored(results(), pd.DataFrame(columns=HEADER), FACTS), tmp_path
    )
    stored = json.loads((tmp_path / "metrics.json").read_text())
    assert set(stored) == {"novel_view", "novel_pose"}
    for split in stored.values():
        assert {"full", "splat", "floor"} <= set(split)
        for scores in split.values():
            for metric in METRICS:
                assert scores[metric] is not None or scores[f"{metric}_reason"]
            for means in scores["cameras"].values():
                assert set(means) == set(METRICS)
    assert json.loads((tmp_path / "facts.json").read_text()) == FACTS
    assert not list(tmp_path.glob("*.part"))


def test_notes_say_each_thing_once():
    said = notes(results())
    assert len(said) == len(set(said)) == 6


def test_a_caption_names_what_is_not_known():
    from gsgan.evaluate.origin import caption

    unknown = FACTS | {
        "model": None,
        "protocol": None,
        "seed": None,
        "commit": None,
        "dirty": None,
    }
    said = caption(unknown)
    assert "protocol none" in said
    assert "seed unknown" in said
    assert "commit unknown" in said
    assert said.startswith("gsgan · ")
