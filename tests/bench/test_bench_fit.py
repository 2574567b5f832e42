"""`gsgan.bench fit`: noise goes by fitting, and what it refuses."""

from __future__ import annotations

import json

import pytest

from gsgan.bench.fit import run
from gsgan.utils.errors import ConfigError

SMALL = (
    *("size.picture=64", "data.source.frames=3", "data.source.rays_per_pixel=1", "noise=0.02"),
    *("fit.shape_steps=40", "fit.sweeps=10", "fit.densify.points_per_limb=20"),
)


def test_fitting_takes_noise_away(compose, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:fit -->\n<!-- end -->\n")
    run(compose("bench_fit", *SMALL, 'settings=["fit.sweeps=1"]', f"docs={page}"), tmp_path)
    record = json.loads((tmp_path / "fit.json").read_text())
    whole, short = record["fits"]
    assert whole["error"] < 0.9 * record["start"]
    assert whole["error"] < short["error"]
    assert whole["iou"] > short["iou"]
    assert f"| fit.sweeps=1 | {1000 * short['error']:.1f} |" in page.read_text()


@pytest.mark.parametrize("wrong", ["settings=fit.sweeps", "settings=[1]", "docs=/not/there.md"])
def test_what_makes_no_sense_is_refused_before_fitting(compose, tmp_path, wrong):
    with pytest.raises(ConfigError, match=wrong.split("=")[0]):
        run(compose("bench_fit", *SMALL, wrong), tmp_path)
