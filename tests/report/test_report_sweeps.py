"""``table.by``: a sweep over settings as rows."""

from pathlib import Path

import pytest
import yaml
from report_folders import report_of, row, table, texts, write_run

from gsgan.utils.errors import ConfigError

KEY = "training.step_two.adversarial"


def swept(folder: Path, weight: float, seed: int, psnr: float, **more) -> Path:
    run = write_run(folder / f"{weight}_{seed}", "full", seed, psnr=psnr)
    config = {
        "seed": seed,
        "training": {"step_two": {"adversarial": weight, **more}},
    }
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
    assert labels == [
        f"full, adversarial {w}" for w in ("0", "0.002", "2", "10")
    ]
    assert texts(row(grid, "full, adversarial 2"))[0] == "32.50 ± 0.71"


def test_without_it_they_are_refused_and_so_is_any_other_difference(tmp_path):
    runs = [swept(tmp_path, weight, 0, 30.0) for weight in (0.0, 0.5)]
    with pytest.raises(ConfigError, match="seed"):
        report_of(table(), *runs)
    other = swept(tmp_path, 0.5, 1, 30.0, perceptual=3.0)
    with pytest.raises(ConfigError, match=r"training\.step_two\.perceptual"):
        report_of(table(by=[KEY]), *runs, other)


def test_a_setting_that_a_run_does_not_have_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"table\.by.*training\.nothing"):
        report_of(table(by=["training.nothing"]), swept(tmp_path, 0.5, 0, 30.0))
    with pytest.raises(ConfigError, match=rf"table\.by.*{KEY}"):
        report_of(table(by=[KEY]), write_run(tmp_path / "bare", psnr=30.0))


def test_rows_cannot_be_given_beside_by():
    with pytest.raises(ConfigError, match=r"table\.by.*table\.rows"):
        table(by=[KEY], rows=[{"run": "full"}])
