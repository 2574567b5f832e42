"""The verdict, the tables and the pictures, from rows whose figures are known."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hydra.utils import instantiate
from rich.console import Console

from gsgan.bench import raster_plots, raster_report
from gsgan.bench.environment import Environment
from gsgan.bench.raster_cell import Row
from gsgan.bench.raster_marks import Marks, growth, verdict
from gsgan.bench.raster_report import Report

REFERENCE = {"gaussians": 8000, "size": 512}
MARKS = Marks(8, 10, 5, 2, 1e-4, 1e-3, 2000, 1)
WHERE = Environment("cpu", "Abacus", 2, "2026-01-01", {"torch": "2"}, 0.1)
AUTO = {"standard": "native", "high": "native"}


def row(backend: str, setting: str, forward: float, both: float, **more) -> Row:
    return replace(Row(8000, 3, 512, backend, setting, forward, both), **more)


def judged(backend: str, setting: str, forward: float, both: float, value: float) -> Row:
    gradients = {"means": 5 * value, "scales": 7 * value}
    return row(
        backend, setting, forward, both, value_max=value, value_mean=value / 10, bound=2 * value,
        beyond=-value, gradients=gradients, gradients_max={"means": value}, memory_mb=300.0,
    )  # fmt: skip


@pytest.fixture
def rows() -> list[Row]:
    """All marks reached, with room to spare; time grows with the root of N and of pixels."""
    found = [
        judged("native", "high", 9.0, 18.0, 1e-5),
        judged("native", "standard", 6.0, 10.0, 2e-2),
        judged("torch", "high", 90.0, 180.0, 1e-5),
        judged("torch", "standard", 60.0, 120.0, 2e-2),
        row("dense", "float32", 600.0, 1800.0),
    ]
    fewer = [replace(r, gaussians=2000, forward_ms=r.forward_ms / 2, both_ms=r.both_ms / 2)
             for r in found[:4]]  # fmt: skip
    smaller = [replace(r, size=128, forward_ms=r.forward_ms / 4, both_ms=r.both_ms / 4)
               for r in found[:4]]  # fmt: skip
    return [*fewer, *found, *smaller]


@pytest.fixture
def report(rows) -> Report:
    return Report(rows, REFERENCE, MARKS, 1e-5, AUTO, WHERE)


def lines(rows: list[Row], auto: dict[str, str] = AUTO) -> dict[str, tuple[str, str]]:
    return {
        line.what: (line.found, line.verdict)
        for line in verdict(rows, REFERENCE, MARKS, 1e-5, auto)
    }


def test_ratios_are_taken_at_the_reference(rows):
    found = lines(rows)
    assert found["native over torch, C=3, forward"] == ("10.0", "reached")
    assert found["native over torch, C=3, forward + backward"] == ("12.0", "reached")
    assert found["torch over dense float32, C=3, forward"] == ("10.0", "reached")
    assert found["torch over dense float32, C=3, forward + backward"] == ("15.0", "reached")
    assert found["native: high over standard, C=3, forward"] == ("1.50", "reached")
    assert found["native: high over standard, C=3, forward + backward"] == ("1.80", "reached")
    assert found["torch: peak memory, MB"] == ("300", "reached")
    assert found["high: largest value error"] == ("1.00e-05", "reached")
    assert found["high: worst gradient error, relative"] == ("7.00e-05", "reached")
    assert found["auto, standard: backend"] == ("native", "reached")
    assert found["native: exponent of time in Gaussians"] == ("0.500", "reached")
    assert found["torch: exponent of time in pixels"] == ("0.500", "reached")
    assert {v for _, v in found.values()} == {"reached"}


def spoil(rows, backend, setting, **changes):
    return [
        replace(r, **changes)
        if (r.backend, r.setting, r.gaussians, r.size) == (backend, setting, 8000, 512)
        else r
        for r in rows
    ]


@pytest.mark.parametrize(
    ("backend", "setting", "changes", "missed"),
    [
        ("native", "standard", {"forward_ms": 7.6}, {"native over torch, C=3, forward"}),
        ("native", "standard", {"both_ms": 12.1}, {"native over torch, C=3, forward + backward"}),
        ("dense", "float32", {"forward_ms": 299}, {"torch over dense float32, C=3, forward"}),
        ("native", "high", {"forward_ms": 12.1}, {"native: high over standard, C=3, forward"}),
        ("torch", "high", {"memory_mb": 2001.0}, {"torch: peak memory, MB"}),
        ("torch", "high", {"value_max": 1.1e-4}, {"high: largest value error"}),
        ("native", "high", {"gradients": {"t": 2e-3}}, {"high: worst gradient error, relative"}),
        ("torch", "standard", {"beyond": 2e-5}, {"every setting: error above its proven bound"}),
    ],
)  # fmt: skip
def test_each_mark_can_be_missed(rows, backend, setting, changes, missed):
    found = lines(spoil(rows, backend, setting, **changes))
    assert {what for what, (_, v) in found.items() if v == "missed"} == missed


def test_steep_growth_and_another_backend_are_missed(rows):
    steep = spoil(rows, "torch", "high", both_ms=180.0 * 9)
    found = lines(steep, {"standard": "torch"})
    missed = {what for what, (_, v) in found.items() if v == "missed"}
    assert missed == {
        "torch: exponent of time in Gaussians",
        "torch: exponent of time in pixels",
        "auto, standard: backend",
    }


def test_what_was_not_measured_is_not_called_reached(rows):
    found = lines([r for r in rows if r.backend != "torch"])
    assert found["native over torch, C=3, forward"] == ("–", "not measured")
    assert found["torch: peak memory, MB"] == ("–", "not measured")
    empty = lines([Row(10, 3, 16, "native", "high", 1.0, 2.0)])
    assert empty["high: largest value error"] == ("–", "not measured")


def test_growth_is_along_one_axis_with_the_other_at_the_reference(rows):
    by_n = growth(rows, REFERENCE, "gaussians", "both_ms")
    assert by_n["native", "standard", 3] == ([2000, 8000], [5.0, 10.0])
    by_pixels = growth(rows, REFERENCE, "size", "forward_ms")
    assert by_pixels["torch", "high", 3] == ([128**2, 512**2], [22.5, 90.0])
    assert not any(key[0] == "dense" for key in by_n)


def test_everything_is_written(report, tmp_path):
    raster_report.write(report, tmp_path, {"repeats": 7})
    assert {p.name for p in tmp_path.iterdir()} == {
        "raster.md", "raster.csv", "raster.json", "raster_error.png", "raster_growth.png"
    }  # fmt: skip
    table = list(csv.DictReader((tmp_path / "raster.csv").open()))
    assert len(table) == len(report.rows)
    chosen = next(
        r for r in table if (r["backend"], r["setting"], r["size"]) == ("native", "high", "128")
    )
    assert float(chosen["gradient"]) == pytest.approx(7e-5)
    assert float(chosen["gradient_means"]) == pytest.approx(5e-5)
    numbers = json.loads((tmp_path / "raster.json").read_text())
    assert numbers["bench"] == {"repeats": 7}
    assert len(numbers["rows"]) == len(report.rows)
    assert numbers["where"]["hardware"] == "Abacus"
    page = (tmp_path / "raster.md").read_text()
    assert "Abacus" in page
    assert "| 8000 | 3 | 512² | native | high | 9.00 | 18.0 | 1.0e-05 |" in page
    widths = {line.count("|") for line in page.splitlines() if line.startswith("| 8000")}
    assert widths == {len(raster_report.HEADER) + 1}


def test_the_page_gets_tables_and_pictures(report, tmp_path):
    docs = tmp_path / "docs" / "page.md"
    docs.parent.mkdir()
    docs.write_text("before <!-- bench:raster --> <!-- end --> after")
    raster_report.write_docs(report, docs)
    text = docs.read_text()
    assert text.startswith("before")
    assert text.endswith("after")
    for name in raster_report.PICTURES:
        assert f"](pictures/{name})" in text
        assert (docs.parent / "pictures" / name).is_file()
    assert "| 8000 | 512² | 6.00 / 10.0 | 60.0 / 120 |" in text
    assert "| 2000 | 512² | 3.00 / 5.00 | 30.0 / 60.0 |" in text


def test_the_console_shows_every_mark(report):
    console = Console(record=True, width=140, file=open("/dev/null", "w"))  # noqa: SIM115
    raster_report.show(report, console)
    text = console.export_text()
    for line in report.verdict:
        assert line.what in text


def pixels(png: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def coloured(picture: np.ndarray, colour: str) -> int:
    rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(picture[..., ::-1].astype(int) - rgb).max(-1) < 12).sum())


def test_pictures_draw_each_backend_in_its_colour(report):
    error = pixels(raster_plots.error_picture(report.at_reference))
    curves = pixels(raster_plots.growth_picture(report.rows, REFERENCE))
    for picture in (error, curves):
        assert min(picture.shape[:2]) > 300
        for backend in ("native", "torch"):
            assert coloured(picture, raster_plots.COLOURS[backend]) > 100, backend
    only = [r for r in report.at_reference if r.backend == "torch"]
    alone = pixels(raster_plots.error_picture(only))
    assert coloured(alone, raster_plots.COLOURS["native"]) == 0


def test_pictures_of_nothing_are_empty_not_an_error():
    rows = [Row(10, 3, 16, "native", "exact", 1.0, 2.0, value_max=0.0, gradients={"means": 0.0})]
    for png in (
        raster_plots.error_picture(rows),
        raster_plots.error_picture([]),
        raster_plots.growth_picture([], REFERENCE),
    ):
        assert coloured(pixels(png), raster_plots.COLOURS["native"]) == 0


def test_the_marks_are_the_configs(compose):
    config = compose("bench_raster")
    marks = instantiate(config.marks)
    assert marks == MARKS
