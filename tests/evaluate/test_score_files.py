"""What is written: every digit, and nothing that JSON does not have."""

import csv
import math

import pandas as pd
import pytest

from gsgan.evaluate.files import HEADER, Scored, write_scored
from gsgan.evaluate.scores import no_scores
from gsgan.metrics.names import METRICS


def variant() -> dict:
    return no_scores(METRICS, "none") | {
        "images": 1,
        "marks": [],
        "lpips_input": None,
        "cameras": {},
        "protocol": None,
    }


def scored(split: str) -> Scored:
    facts = {
        "method": "m", "model": None, "protocol": None, "seed": 0, "iterations": 5,
        "data": {"name": "d", "root": "r", "fingerprint": "f"}, "commit": None, "dirty": None,
        "version": "1",
    }  # fmt: skip
    row = {"split": split, "variant": "full", "camera": "001", "frame": 3}
    row |= {
        "psnr": 1 / 3,
        "ssim": math.inf,
        "lpips_alex": 1e-05,
        "miou": math.nan,
    }
    rows = pd.DataFrame([row], columns=HEADER)
    return Scored({split: {"full": variant()}}, rows, facts)


def test_the_csv_keeps_every_digit(tmp_path):
    path = tmp_path / "scores.csv"
    write_scored(scored("novel_pose"), tmp_path)
    with path.open() as stream:
        (line,) = csv.DictReader(stream)
    assert tuple(line) == HEADER
    assert float(line["psnr"]) == 1 / 3
    assert (line["ssim"], line["miou"], line["lpips_alex"]) == (
        "inf",
        "",
        "1e-05",
    )
    assert (line["split"], line["camera"], line["frame"]) == (
        "novel_pose",
        "001",
        "3",
    )


def test_nothing_that_json_does_not_have_is_written(tmp_path):
    broken = scored("novel_pose")
    broken.results["novel_pose"]["full"]["psnr"] = math.nan
    with pytest.raises(ValueError, match="JSON"):
        write_scored(broken, tmp_path)
    assert not (tmp_path / "metrics.json").exists()
