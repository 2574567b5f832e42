"""What is written: every digit, and never scores of different ways in one table."""

import csv
import math

import pandas as pd
import pytest

from gsgan.evaluate.files import HEADER, Scored, joined, read_rows, write_scored
from gsgan.evaluate.scores import no_scores
from gsgan.metrics.names import METRICS


def variant(protocol: str | None = None) -> dict:
    return no_scores(METRICS, "none") | {
        "images": 1,
        "marks": [],
        "lpips_name": None,
        "cameras": {},
        "protocol": protocol and {"name": protocol, "source": "", "departures": []},
    }


def scored(
    split: str, seed: int = 0, protocol: str | None = None, commit: str | None = None
) -> Scored:
    facts = {
        "method": "m", "model": None, "protocol": protocol, "seed": seed, "iterations": 5,
        "data": {"name": "d", "root": "r", "fingerprint": "f"}, "commit": commit, "dirty": None,
        "version": "1",
    }  # fmt: skip
    row = {"split": split, "variant": "full", "camera": "001", "frame": 3}
    row |= {"psnr": 1 / 3, "ssim": math.inf, "lpips": 1e-05, "miou": math.nan}
    rows = pd.DataFrame([row], columns=HEADER)
    return Scored({split: {"full": variant(protocol)}}, rows, facts)


def test_the_csv_keeps_every_digit(tmp_path):
    path = tmp_path / "scores.csv"
    write_scored(scored("novel_pose"), tmp_path)
    with path.open() as stream:
        (line,) = csv.DictReader(stream)
    assert tuple(line) == HEADER
    assert float(line["psnr"]) == 1 / 3
    assert (line["ssim"], line["miou"], line["lpips"]) == ("inf", "", "1e-05")
    assert (line["split"], line["camera"], line["frame"]) == ("novel_pose", "001", "3")
    pd.testing.assert_frame_equal(
        read_rows(path), scored("novel_pose").rows, check_exact=True, check_dtype=False
    )


def test_scoring_one_split_keeps_the_others(tmp_path):
    write_scored(scored("novel_pose"), tmp_path)
    whole, dropped = joined(scored("novel_view"), tmp_path, ("novel_view", "novel_pose"))
    assert list(whole.results) == list(whole.rows["split"]) == ["novel_view", "novel_pose"]
    assert dropped == []


@pytest.mark.parametrize("other", [{"seed": 1}, {"protocol": "zju"}, {"commit": "abc"}])
def test_scores_of_another_way_are_not_mixed_in(tmp_path, other):
    write_scored(scored("novel_pose", **other), tmp_path)
    whole, dropped = joined(scored("novel_view"), tmp_path, ("novel_view", "novel_pose"))
    assert list(whole.results) == ["novel_view"]
    assert dropped == ["novel_pose"]


def test_damaged_earlier_scores_are_left_out(tmp_path):
    write_scored(scored("novel_pose"), tmp_path)
    (tmp_path / "scores.csv").write_text("split,psnr\n")
    whole, dropped = joined(scored("novel_view"), tmp_path, ("novel_view", "novel_pose"))
    assert list(whole.results) == ["novel_view"]
    assert dropped == ["novel_pose"]
    (tmp_path / "metrics.json").write_text("{")
    assert joined(scored("novel_view"), tmp_path, ("novel_view",))[1] == []
    assert not list(tmp_path.glob(".*.part"))


def test_nothing_that_json_does_not_have_is_written(tmp_path):
    broken = scored("novel_pose")
    broken.results["novel_pose"]["full"]["psnr"] = math.nan
    with pytest.raises(ValueError, match="JSON"):
        write_scored(broken, tmp_path)
    assert not (tmp_path / "metrics.json").exists()
