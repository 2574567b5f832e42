"""The raster bench on scenes of seconds: cells, resuming, every way to go wrong."""

from __future__ import annotations

import inspect
import json

import pytest
import torch
from hydra.utils import instantiate

from gsgan.bench import memory, raster, raster_report
from gsgan.bench.raster import RasterBench
from gsgan.bench.raster_cell import Cell, Row, measure_cell
from gsgan.splat import ACCURACY, accuracy, resolve_backend
from gsgan.utils.config import one_sentence
from gsgan.utils.errors import GsganError

CPU = torch.device("cpu")
SMALL = (
    "gaussians=[60,120]", "channels=[2]", "sizes=[24]", "repeats=2", "threads=1",
    "reference.gaussians=120", "reference.size=24", "dense_channels=[2]", "judge_at=[120]",
    "windows=2", "window=12", "memory=false", "device=cpu",
)  # fmt: skip
BACKENDS = ["torch"]
if resolve_backend("native", CPU, ACCURACY["high"])[0] == "native":
    BACKENDS.append("native")


@pytest.fixture
def config(compose):
    return lambda *overrides: compose("bench_raster", *SMALL, *overrides)


@pytest.fixture
def bench(config):
    return lambda *overrides: instantiate(config(*overrides))


def test_every_key_is_an_argument_and_every_argument_a_key(compose):
    arguments = set(inspect.signature(RasterBench).parameters)
    assert set(compose("bench_raster")) - {"_target_", "_convert_"} == arguments


def test_the_settings_are_those_of_the_accuracy_group(bench):
    assert bench().settings == ACCURACY


def test_a_setting_of_ones_own_is_priced_beside_them(bench):
    found = bench("+accuracy@settings.mine=high", "settings.mine.alpha_min=1e-4")
    assert list(found.settings)[-1] == "mine"
    assert found.settings["mine"].alpha_min == 1e-4
    assert found.settings["high"].alpha_min == 1e-6
    assert "draft" not in bench("~accuracy@settings.draft").settings


def test_the_grid_is_every_combination(bench):
    found = bench("channels=[1,2]", "sizes=[16,24]")
    assert len(found.cells) == 8
    assert Cell(60, 2, 16) in found.cells


def test_variants_are_each_backend_with_each_setting_it_draws(bench):
    names = {(v.backend, v.setting) for v in bench().variants(Cell(60, 2, 24), CPU)}
    assert names == {(b, s) for b in BACKENDS for s in ACCURACY}
    few = {(v.backend, v.setting) for v in bench().variants(Cell(3000, 2, 24), CPU)}
    assert ("torch", "exact") not in few
    assert ("torch", "high") in few
    only = bench("backends=[torch]").variants(Cell(60, 2, 24), CPU)
    assert {v.backend for v in only} == {"torch"}


@pytest.fixture(scope="module")
def rows():
    """One measured cell."""
    from hydra import compose, initialize_config_dir

    from gsgan.utils.config import config_folder

    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        bench = instantiate(compose("bench_raster", overrides=list(SMALL)))
    said: list[str] = []
    found = measure_cell(bench.job(Cell(120, 2, 24), CPU), CPU, said.append)
    assert said == ["timing", "judging", "dense float32, once"]
    return found


def test_a_cell_times_and_judges_every_variant_and_times_the_dense_one(rows):
    assert [(r.backend, r.setting) for r in rows[:-1]] == [
        (b, s) for b in BACKENDS for s in ACCURACY
    ]
    assert rows[-1].name == "dense, float32 at N=120 C=2 24²"
    for row in rows:
        assert row.both_ms is not None
        assert row.forward_ms is not None
        assert row.forward_ms > 0
        assert row.both_ms > 0
    for row in rows[:-1]:
        assert len(row.forward_samples) == len(row.both_samples) == 2
        assert set(row.gradients or ()) == {"means", "quats", "scales", "opacities", "features"}
        assert row.beyond is not None
        assert row.beyond < 1e-5
    assert len(rows[-1].both_samples) == 1
    assert rows[-1].value_max is None


def test_errors_fall_with_the_setting(rows):
    for backend in BACKENDS:
        found = {r.setting: r for r in rows if r.backend == backend}
        order = ["draft", "standard", "high", "exact"]
        values = [found[s].value_max for s in order]
        assert values == sorted(values, reverse=True)
        assert found["high"].gradient < 1e-3 < found["draft"].gradient


@pytest.fixture
def measured(monkeypatch):
    """The cells that were measured, by figures from nowhere; 999 Gaussians are interrupted."""
    cells: list[Cell] = []

    def measure(job, device, say):
        if job.cell.gaussians == 999:
            raise KeyboardInterrupt
        cells.append(job.cell)
        n, c, size = vars(job.cell).values()
        return [Row(n, c, size, v.backend, v.setting, 1.0, 2.0) for v in job.variants]

    monkeypatch.setattr(raster, "measure_cell", measure)
    monkeypatch.setattr(raster_report, "_write_pictures", lambda *_: None)
    return cells


def test_a_second_run_measures_nothing_but_what_is_new(config, tmp_path, measured):
    raster.run(config(), tmp_path)
    assert measured == [Cell(60, 2, 24), Cell(120, 2, 24)]
    first = json.loads((tmp_path / "raster.json").read_text())
    raster.run(config(), tmp_path)
    assert len(measured) == 2
    assert json.loads((tmp_path / "raster.json").read_text())["rows"] == first["rows"]
    raster.run(config("gaussians=[60,120,180]"), tmp_path)
    assert measured[2:] == [Cell(180, 2, 24)]


@pytest.mark.parametrize(
    "change",
    ["seed=1", "fresh=true", "repeats=3", "settings.high.alpha_min=1e-5", "shape=covariances"],
)
def test_figures_of_other_conditions_are_not_taken(config, tmp_path, measured, change):
    raster.run(config(), tmp_path)
    raster.run(config(change), tmp_path)
    assert len(measured) == 4


def test_figures_of_other_code_are_not_taken(config, tmp_path, measured, monkeypatch):
    raster.run(config(), tmp_path)
    monkeypatch.setattr(raster, "_code", lambda: "other")
    raster.run(config(), tmp_path)
    assert len(measured) == 4


def test_the_digest_of_the_code_covers_kernels_and_measuring(monkeypatch):
    found = []
    monkeypatch.setattr(raster, "source_digest", lambda paths: found.extend(paths))
    raster._code()
    names = {path.name for path in found}
    assert {"native.cpp", "tile.h", "project.h", "tiles.py", "timing.py", "memory.py"} <= names


def test_an_interrupted_run_keeps_its_finished_cells(config, tmp_path, measured):
    with pytest.raises(KeyboardInterrupt):
        raster.run(config("gaussians=[60,999]"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["measurements.jsonl"]
    raster.run(config("gaussians=[60,120]"), tmp_path)
    assert measured == [Cell(60, 2, 24), Cell(120, 2, 24)]
    assert (tmp_path / "raster.md").is_file()


def test_an_error_beyond_its_bound_is_written_and_ends_in_an_error(config, tmp_path):
    with pytest.raises(GsganError, match="wrong by more than their proven bound"):
        raster.run(config("rounding=-1"), tmp_path)
    assert (tmp_path / "raster.md").is_file()


def test_the_page_is_rewritten(config, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:raster --><!-- end -->")
    raster.run(config(f"docs={page}", "gaussians=[120]", "dense=false"), tmp_path / "out")
    assert "| 2 | torch | high |" in page.read_text()


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("gaussians=[]", "gaussians must not be empty"),
        ("gaussians=[5]", "gaussians must list whole numbers of at least 24, got [5]"),
        ("channels=3", "channels must list whole numbers"),
        ("judge_at=8000", "judge_at must list whole numbers"),
        ("sizes=[64.5]", "sizes must list whole numbers"),
        ("repeats=0", "repeats must be a whole number of at least 1, got 0"),
        ("repeats=2.5", "repeats must be a whole number of at least 1, got 2.5"),
        ("threads=0", "threads must be a whole number of at least 1, got 0"),
        ("patience=null", "patience must be a number of at least 0, got None"),
        ("marks.growth=null", "marks.growth must be a number of at least 0, got None"),
        ("exact_upto=0", "exact_upto must give the Gaussians by backend"),
        ("exact_upto.native=null", "exact_upto.native must be a whole number"),
        ("docs=nowhere.md", "docs=nowhere.md: no such page"),
        ("backends=native", "backends must be auto or a list of torch, native"),
        ("backends=[reference]", "backends must be auto or a list of torch, native"),
        ("backends=[abacus]", "backends must be auto or a list of"),
        ("shape=cubes", "shape must be one of quats, covariances, got cubes"),
        ("+reference.frames=3", "reference must have gaussians and size"),
        ("settings.high.alpha_min=2", "alpha_min must be in [0, 1), got 2"),
        ("device=abacus", "device=abacus: not usable here"),
    ],
)
def test_mistakes_are_one_sentence(config, tmp_path, override, named):
    with pytest.raises(Exception) as caught:  # noqa: PT011 (the sentence is what is checked)
        raster.run(config(override), tmp_path)
    assert named in (one_sentence(caught.value) or "")
    assert not list(tmp_path.iterdir())


def job(**changes):
    return {
        "n": 100, "channels": 2, "size": 16, "settings": vars(accuracy("high")), "seed": 0,
        "backend": "torch", "shape": "quats", "device": "cpu", "threads": 1,
    } | changes  # fmt: skip


@pytest.mark.slow
def test_peak_memory_is_what_a_pass_takes_whatever_the_parent_holds():
    held = torch.ones(50_000_000)  # 200 MB that the child must not count
    scene = {"seed": 0, "shape": "quats", "device": "cpu", "threads": 1}
    small = memory.peak_memory(200, 3, 32, accuracy("high"), "torch", **scene)
    large = memory.peak_memory(200, 64, 256, accuracy("high"), "torch", **scene)
    assert small is not None
    assert large is not None
    # The picture and its gradients, 64 x 256² floats, are 17 MB each.
    assert small < 50
    assert 17 < large < 400
    assert held.sum() == 50_000_000


def test_a_pass_that_fails_has_no_memory_and_says_why(monkeypatch, caplog):
    monkeypatch.setattr(memory.sys, "executable", "false")
    scene = {"seed": 0, "shape": "quats", "device": "cpu", "threads": 1}
    assert memory.peak_memory(200, 3, 32, accuracy("high"), "torch", **scene) is None
    assert "No peak memory of torch, high: it ended with 1" in caplog.text


def test_the_child_measures_in_megabytes(monkeypatch):
    peaks = iter([1e6, 5e6, 12e6])
    monkeypatch.setattr(memory, "peak", lambda device: next(peaks))
    monkeypatch.setattr(memory, "reset_peak", lambda device: None)
    assert memory.measure(job()) == 7.0
