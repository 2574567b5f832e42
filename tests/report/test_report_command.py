"""``python -m gsgan.report`` as a user types it, and its config."""

from dataclasses import fields

import pandas as pd
import pytest
from commands import refused
from hydra.utils import instantiate
from report_folders import write_run

from gsgan.report.figures.run import FigureOptions
from gsgan.report.table import TableOptions
from gsgan.run.runs import RunReference
from gsgan.utils.config import config_folder

FILES = {"report.md", "report.tex", "report.csv"}


@pytest.fixture
def sweep(tmp_path):
    folder = tmp_path / "sweep"
    for model, values in (("full", (30.0, 31.0)), ("wo_seg", (29.5, 31.25))):
        for seed, psnr in enumerate(values):
            write_run(folder / f"{model}_{seed}", model, seed, psnr=psnr)
    (folder / "unfinished" / ".hydra").mkdir(parents=True)
    (folder / "unfinished" / ".hydra" / "config.yaml").write_text("seed: 0\n")
    (folder / "unfinished" / "unfinished.txt").write_text(
        "it was killed by SIGKILL"
    )
    return folder


def test_it_writes_all_files_and_names_what_it_left_out(
    sweep, tmp_path, inside
):
    result = inside("report", f"runs=[{sweep}]", "table=ablation", "out=tables")
    assert result.returncode == 0, result.stderr
    assert "30.50 ± 0.71" in result.stdout
    assert "Left out: unfinished" in result.stdout
    assert "it was killed by SIGKILL" in result.stdout
    out = tmp_path / "tables"
    assert {path.name for path in out.iterdir()} == FILES
    held = pd.read_csv(out / "report.csv").set_index(
        ["table", "row", "column"]
    )["mean"]
    assert held.loc[:, "w/o S", "PSNR dB ↑"].item() == pytest.approx(30.375)
    assert not (tmp_path / "outputs").exists()  # Hydra left nothing


def test_a_wrong_value_ends_in_one_message_before_anything_is_written(
    sweep, tmp_path, inside
):
    runs = f"runs=[{sweep}]"
    refused(inside("report"), "runs and run are not set")
    refused(inside("report", "runs=[]"), "runs and run are not set")
    refused(
        inside("report", f"runs=[{tmp_path}/gone]"),
        "gone' contains no run folder",
    )
    refused(
        inside("report", runs, "out=a", "table=zju"),
        "is of zju_mocap",
        "table=plain",
    )
    refused(
        inside("report", runs, "out=a", "table.metrics=[fid]"), "fid", "psnr"
    )
    refused(
        inside("report", runs, "out=a", "table.rows=[{model: full}]"), "model"
    )
    page = tmp_path / "page.md"
    page.write_text("a file")
    assert not (tmp_path / "a").exists()
    refused(inside("report", runs, f"out={page}/x"), "cannot be written")


@pytest.mark.parametrize(
    "name", sorted(p.stem for p in (config_folder() / "table").glob("*"))
)
def test_every_table_composes_and_its_keys_are_read(compose, name):
    config = compose("report", f"table={name}")
    assert instantiate(config.table).name == name
    read = set[str]()
    for options in (TableOptions, FigureOptions, RunReference):
        read.update(field.name for field in fields(options))
    assert set(config) <= read
