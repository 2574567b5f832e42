"""`gsgan.bench rays`: more rays come nearer to the truth, and what it refuses."""

from __future__ import annotations

import json

import pytest

from gsgan.bench.rays import run
from gsgan.utils.errors import ConfigError

SMALL = ("reference=36", "picture=24", "frames=1")


def test_more_rays_come_nearer_to_the_truth(compose, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:rays -->\n<!-- end -->\n")
    run(compose("bench_rays", *SMALL, "rays=[1,16]", f"docs={page}"), tmp_path)
    few, many = json.loads((tmp_path / "rays.json").read_text())["rays"]
    assert few["rays"] == 1
    assert few["worst"] <= few["psnr"] < many["psnr"] - 3
    assert f"| 16 | {many['psnr']:.1f} |" in page.read_text()


@pytest.mark.parametrize(
    "wrong", ["rays=[]", "rays=[36]", "rays=4", "rays=[1.5]", "docs=/not/there.md"]
)
def test_what_makes_no_sense_is_refused_before_tracing(compose, tmp_path, wrong):
    with pytest.raises(ConfigError, match=wrong.split("=")[0]):
        run(compose("bench_rays", *SMALL, wrong), tmp_path)
