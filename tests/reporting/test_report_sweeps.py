"""``table.by``: a sweep over settings as rows and as curves."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from report_folders import report_of, row, table, texts, write_run

from gsgan.errors import ConfigError
from gsgan.reporting.writers.curves import picture

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
    assert texts(row(grid, "full, adversarial 2")) == ["32.50 ± 0.71"]


def test_without_it_they_are_refused_and_so_is_any_other_difference(tmp_path):
    runs = [swept(tmp_path, weight, 0, 30.0) for weight in (0.0, 0.5)]
    with pytest.raises(ConfigError, match="one row's same seed"):
        report_of(table(), *runs)
    other = swept(tmp_path, 0.5, 1, 30.0, perceptual=3.0)
    with pytest.raises(ConfigError, match=r"more than the seed: training\.step_two\.perceptual"):
        report_of(table(by=[KEY]), *runs, other)


def test_a_setting_that_a_run_does_not_have_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"table\.by: .*has no setting training\.nothing"):
        report_of(table(by=["training.nothing"]), swept(tmp_path, 0.5, 0, 30.0))
    with pytest.raises(ConfigError, match=rf"table\.by: .*has no setting {KEY}"):
        report_of(table(by=[KEY]), write_run(tmp_path / "bare", psnr=30.0))


@pytest.mark.parametrize("by", [[], "training", [["a"]], [KEY, KEY]])
def test_what_is_no_list_of_settings_is_refused(by):
    with pytest.raises(ConfigError, match=r"table\.by"):
        table(by=by)
    with pytest.raises(ConfigError, match=r"table\.rows must be null"):
        table(by=[KEY], rows=[{"run": "full"}])


def test_the_picture_shows_a_panel_a_score_that_there_is(tmp_path):
    import cv2
    import numpy as np

    runs = [swept(tmp_path, w, s, 30 + s + w) for w in (0, 0.5) for s in (0, 1)]
    one = picture(report_of(table(by=[KEY]), *runs))  # LPIPS is not there
    pixels = cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape[0] / pixels.shape[1] == pytest.approx((2.5 + 0.4) / 3.1, rel=0.05)
    assert pixels.std() > 5


def test_the_command_writes_the_curves_beside_the_tables(tmp_path, inside):
    runs = [swept(tmp_path / "s", w, 0, 30 + w) for w in (0, 0.5)]
    assert len(runs) == 2
    given = [f"runs=[{tmp_path / 's'}]", f"table.by=[{KEY}]", "out=tables"]
    result = inside("report", *given)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "tables" / "report.png").stat().st_size > 2000
    assert "adversarial 0.5" in (tmp_path / "tables" / "report.md").read_text()
