"""``table.by``: a sweep over settings as rows and as curves."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from report_folders import report_of, row, table, texts, variant, write_run

from gsgan.report.curves import curves
from gsgan.utils.errors import ConfigError

KEY = "training.step_two.adversarial"


def swept(folder: Path, weight: float, seed: int, psnr: float, **more) -> Path:
    run = write_run(folder / f"{weight}_{seed}", "full", seed, psnr=psnr)
    config = {"seed": seed, "training": {"step_two": {"adversarial": weight, **more}}}
    (run / ".hydra").mkdir()
    (run / ".hydra" / "config.yaml").write_text(yaml.safe_dump(config))
    return run


def test_values_of_a_setting_are_rows_in_their_order(tmp_path):
    runs = [
        swept(tmp_path, weight, seed, 30 + seed + weight)
        for weight in (10, 0.002, 2, 0)
        for seed in (0, 1)
    ]
    (grid,) = report_of(table(by=[KEY]), *runs).grids
    labels = [r.label for r in grid.rows if r.kind == "run"]
    assert labels == [f"full, adversarial {w}" for w in ("0", "0.002", "2", "10")]
    assert texts(row(grid, "full, adversarial 2"))[0] == "32.50 ± 0.71"


def test_without_it_they_are_refused_and_so_is_any_other_difference(tmp_path):
    runs = [swept(tmp_path, weight, 0, 30.0) for weight in (0.0, 0.5)]
    with pytest.raises(ConfigError, match="the same row and seed"):
        report_of(table(), *runs)
    other = swept(tmp_path, 0.5, 1, 30.0, perceptual=3.0)
    with pytest.raises(ConfigError, match=r"differ in settings: training\.step_two\.perceptual"):
        report_of(table(by=[KEY]), *runs, other)


def test_a_setting_that_a_run_does_not_have_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"table\.by: .*has no setting training\.nothing"):
        report_of(table(by=["training.nothing"]), swept(tmp_path, 0.5, 0, 30.0))
    with pytest.raises(ConfigError, match=rf"table\.by: .*has no setting {KEY}"):
        report_of(table(by=[KEY]), write_run(tmp_path / "bare", psnr=30.0))


def test_rows_cannot_be_given_beside_by():
    with pytest.raises(ConfigError, match=r"table\.rows must be null"):
        table(by=[KEY], rows=[{"run": "full"}])


def test_the_curves_have_a_panel_per_metric_that_runs_have(tmp_path):
    runs = [swept(tmp_path, w, s, 30 + s + w) for w in (0, 0.5) for s in (0, 1)]
    one = curves(report_of(table(by=[KEY]), *runs))  # LPIPS is not there
    pixels = cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape[0] / pixels.shape[1] == pytest.approx((3.0 + 0.5) / 3.1, rel=0.05)
    assert pixels.std() > 5


def test_models_and_variants_are_lines_of_their_own(tmp_path, monkeypatch):
    from matplotlib.axes import Axes

    lines = []
    plain = Axes.errorbar

    def errorbar(self, x, y, **options):
        lines.append((options["label"], list(x), list(y)))
        return plain(self, x, y, **options)

    monkeypatch.setattr(Axes, "errorbar", errorbar)
    splat = variant(psnr=20.0)
    runs = [swept(tmp_path, w, 0, 30 + w) for w in (2, 0)]
    for run in runs:
        scores = json.loads((run / "metrics.json").read_text())
        scores["novel_pose"]["splat"] = splat
        (run / "metrics.json").write_text(json.dumps(scores))
    runs.append(swept(tmp_path / "o", 2, 0, 25.0))
    facts = json.loads((runs[-1] / "facts.json").read_text())
    (runs[-1] / "facts.json").write_text(json.dumps(facts | {"model": "wo_seg"}))
    spec = table(by=[KEY], metrics=["psnr"], variants=["full", "splat"])
    assert curves(report_of(spec, *runs))
    assert lines == [
        ("full", [0, 1], [30.0, 32.0]),
        ("full: Step I's colour", [0, 1], [20.0, 20.0]),
        ("wo_seg", [1], [25.0]),
    ]


def test_the_command_writes_the_curves_beside_the_tables(tmp_path, inside):
    runs = [swept(tmp_path / "s", w, 0, 30 + w) for w in (0, 0.5)]
    assert len(runs) == 2
    given = [f"runs=[{tmp_path / 's'}]", f"table.by=[{KEY}]", "out=tables"]
    result = inside("report", *given)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "tables" / "report.png").stat().st_size > 2000
    assert "adversarial 0.5" in (tmp_path / "tables" / "report.md").read_text()
