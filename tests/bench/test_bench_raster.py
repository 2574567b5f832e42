"""The raster bench on scenes of seconds: cells, tables, every wrong key."""

from __future__ import annotations

import pandas as pd
import pytest
import torch
from hydra.utils import instantiate

from gsgan.bench import raster
from gsgan.bench.raster import (
    error_plot,
    growth_table,
    measure_cell,
    number_table,
    summary,
    variants,
)
from gsgan.splat import ACCURACY, resolve_backend
from gsgan.utils.config import one_sentence
from gsgan.utils.errors import GsganError

CPU = torch.device("cpu")
SMALL = (
    "gaussians=[60,120]", "channels=[2]", "sizes=[24]", "repeats=2", "threads=1",
    "reference.gaussians=120", "reference.size=24", "compare_at=[120]",
    "windows=2", "window=12", "memory=false", "device=cpu",
)  # fmt: skip
BACKENDS = ["torch"]
if resolve_backend("native", CPU, ACCURACY["high"])[0] == "native":
    BACKENDS.append("native")


@pytest.fixture
def config(compose):
    return lambda *overrides: compose("bench_raster", *SMALL, *overrides)


def settings(config):
    return {name: instantiate(one) for name, one in config.settings.items()}


def test_the_settings_are_those_of_the_accuracy_group_and_ones_own(config):
    assert settings(config()) == ACCURACY
    found = settings(config("+accuracy@settings.mine=high", "settings.mine.alpha_min=1e-4"))
    assert found["mine"].alpha_min == 1e-4
    assert found["high"].alpha_min == 1e-5


def test_variants_are_each_backend_with_each_setting_it_draws(config):
    names = {v[:2] for v in variants(config(), ACCURACY, 60, CPU)}
    assert names == {(b, s) for b in BACKENDS for s in ACCURACY}
    few = {v[:2] for v in variants(config(), ACCURACY, 3000, CPU)}
    assert ("torch", "exact") not in few
    assert ("torch", "high") in few
    assert {v[0] for v in variants(config("backends=[torch]"), ACCURACY, 60, CPU)} == {"torch"}


def test_a_cell_times_and_compares_every_variant(config):
    found = variants(config(), ACCURACY, 120, CPU)
    cell = {"gaussians": 120, "channels": 2, "size": 24}
    rows = pd.DataFrame(measure_cell(config(), cell, found, CPU, {"GFLOP/s": 50.0, "GB/s": 10.0}))
    assert list(zip(rows.backend, rows.setting, strict=True)) == [v[:2] for v in found]
    assert (rows.forward_ms > 0).all()
    assert (rows.both_ms > 0).all()
    assert (rows.beyond < 1e-5).all()
    assert (rows.over_least[rows.setting != "exact"] > 1).all()
    for _, own in rows.groupby("backend"):
        own = own.set_index("setting")
        falling = own.value_max[["draft", "standard", "high", "exact"]]
        assert falling.is_monotonic_decreasing
        assert own.gradient["high"] < 1e-3 < own.gradient["draft"]


def test_a_real_run_writes_all_files_and_ends_in_an_error_beyond_the_bound(config, tmp_path):
    page, out = tmp_path / "page.md", tmp_path / "out"
    page.write_text("<!-- bench:raster --><!-- end -->")
    with pytest.raises(GsganError, match="wrong by more than their proven bound"):
        raster.run(config("gaussians=[120]", "rounding=0", f"docs={page}"), out)
    assert "| 120 | 2 | 24² | torch | high |" in page.read_text()
    files = {path.name for path in out.iterdir()}
    assert files == {
        "raster.md",
        "raster.csv",
        "raster.json",
        "raster_error.png",
        "raster_growth.png",
    }
    frame = pd.read_csv(out / "raster.csv")
    assert {"gradient_means", "worst_group", "bound"} <= set(frame)
    assert (tmp_path / "pictures" / "raster_error.png").is_file()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("gaussians=[]", "gaussians must be a list of whole numbers, got []"),
        ("gaussians=[5]", "gaussians must be a whole number of at least 24, got 5"),
        ("channels=3", "channels must be a list"),
        ("compare_at=8000", "compare_at must be a list"),
        ("sizes=[64.5]", "sizes must be a whole number of at least 8, got 64.5"),
        ("repeats=2.5", "repeats must be a whole number of at least 1, got 2.5"),
        ("threads=0", "threads must be a whole number of at least 1, got 0"),
        ("patience=null", "patience must be a number of at least 0, got None"),
        ("exact_upto.native=null", "native must be a whole number"),
        ("docs=nowhere.md", "docs=nowhere.md: no such page"),
        ("backends=native", "backends must be auto or a list of torch, native"),
        ("backends=[reference]", "backends must be auto or a list of torch, native"),
        ("settings.high.alpha_min=2", "alpha_min must be in [0, 1), got 2"),
        ("device=abacus", "device=abacus: not usable here"),
    ],
)
def test_mistakes_are_one_sentence(config, tmp_path, override, message):
    with pytest.raises(Exception) as caught:  # noqa: PT011 (the message is checked)
        raster.run(config(override), tmp_path)
    assert message in (one_sentence(caught.value) or "")
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- tables and plots


@pytest.fixture
def frame():
    """Time grows with the root of N and of pixels."""
    rows = []
    for n, size in ((2000, 512), (8000, 512), (8000, 128)):
        for backend, slow in (("native", 1), ("torch", 10)):
            for setting, ms, error in (("high", 9.0, 1e-5), ("standard", 6.0, 2e-2)):
                ms = ms * slow * (n / 8000) ** 0.5 * size / 512
                row = {"gaussians": n, "channels": 3, "size": size, "backend": backend}
                row |= {"setting": setting, "forward_ms": ms, "both_ms": 2 * ms}
                if size == 512:
                    row |= {"value_max": error, "value_mean": error / 10, "bound": 2 * error}
                    row |= {"gradient": 7 * error, "worst_group": "scales", "gradient_max": error}
                rows.append(row)
    return pd.DataFrame(rows)


def test_tables_show_each_row_and_a_dash_for_what_is_missing(frame):
    lines = number_table(frame).splitlines()
    assert (
        "| 8000 | 3 | 512² | native | high | 9.00 | 18.0 | – | 1.0e-05 | 1.0e-06 | 2.0e-05 |"
        in ("\n".join(lines))
    )
    assert len({line.count("|") for line in lines}) == 1
    assert "| 8000 | 3 | 128² | native | high | 2.25 | 4.50 | – |" in "\n".join(lines)
    growth = growth_table(frame)
    assert "| 8000 | 512² | 6.00 / 12.0 | 60.0 / 120 |" in growth
    assert growth.index("| 8000 | 128² |") < growth.index("| 8000 | 512² |")


def test_the_page_shows_the_reference_scene_and_the_plot(frame):
    here = frame[(frame.gaussians == 8000) & (frame["size"] == 512)]
    where = {"device": "cpu", "hardware": "Abacus", "threads": 1, "date": "", "load": None}
    text = summary(frame, here, where | {"versions": {}})
    assert "Abacus" in text
    assert "| 8000 | 3 | 512² | native | high | 9.00 |" in text
    assert "](pictures/raster_error.png)" in text


def test_the_plot_is_drawn_even_of_nothing(frame):
    for rows in (frame, frame[:0].drop(columns=["value_max", "gradient"])):
        assert error_plot(rows).startswith(b"\x89PNG")
