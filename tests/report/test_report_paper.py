"""The paper's numbers: as printed, marked, beside the same data and protocol only."""

import pytest
from omegaconf import OmegaConf
from report_folders import (
    protocol,
    report_of,
    row,
    table,
    texts,
    write_run,
    zju,
)

from gsgan.report.paper import read_paper
from gsgan.report.runs import NAME
from gsgan.utils.errors import ConfigError

ABLATION = {"rows": [{"run": "full"}, {"run": "wo_seg"}], "paper": "ablation"}
VIEW = {"splits": ["novel_view"], "metrics": ["psnr"]}


def paper_run(folder, **held):
    given = {
        "data": zju(377),
        "record": protocol("paper_zju"),
        "splits": ("novel_view",),
    }
    return write_run(folder, psnr=30.0, **(given | held))


def test_beside_the_same_data_subject_protocol_and_split(tmp_path):
    (grid,) = report_of(
        table(**ABLATION, **VIEW), paper_run(tmp_path / "a")
    ).grids
    labels = [r.label for r in grid.rows]
    assert labels[:2] == ["full", "full (as printed)"]
    printed = row(grid, "full (as printed)")
    assert (texts(printed), printed.kind) == (["34.16"], "paper")
    assert printed.cells[0].mean is None  # in no mean of ours
    assert texts(row(grid, "full")) == ["30.00"]
    assert texts(row(grid, "w/o S (as printed)")) == ["29.08"]
    assert labels[-1] == "all background (floor)"


APART = {
    "synthetic": (
        {"data": None, "record": None},
        "of synthetic, the paper's of zju_mocap",
    ),
    "another subject": (
        {"data": zju(386)},
        "CoreView_386, the paper's of subject 377",
    ),
    "no protocol": ({"record": None}, "of protocol none"),
    "another protocol": (
        {"record": protocol("zju_gauhuman")},
        "of protocol zju_gauhuman",
    ),
    "a departure": (
        {"record": protocol("paper_zju", departures=["at scale 1"])},
        "at scale 1",
    ),
}


@pytest.mark.parametrize(("held", "message"), APART.values(), ids=APART)
def test_otherwise_they_have_a_table_of_their_own_with_the_reason(
    tmp_path, held, message
):
    ours, paper = report_of(
        table(**ABLATION, **VIEW), paper_run(tmp_path / "a", **held)
    ).grids
    assert all(r.kind != "paper" for r in ours.rows)
    assert all(
        r.kind == "paper" and "(as printed)" in r.label for r in paper.rows
    )
    assert message in paper.remarks[0]
    departed = ("n/a", "zju_mocap", "the paper's, read as paper_zju", "n/a")
    assert all(r.origin == departed for r in paper.rows)


@pytest.mark.parametrize(
    ("experiment", "overrides", "departed"),
    [
        ("paper", [], ""),
        ("paper", ["model=full", "seed=1", "training.log_every=5", "data.root=/x"], ""),
        ("paper", ["training.step_two.perceptual=2", "size=tiny"],
         "training.step_two.perceptual=2, size=tiny"),
        ("demo", [], "experiment=demo"),
        (None, [], None),
    ],
)  # fmt: skip
def test_only_runs_of_experiment_paper_have_the_papers_name(
    tmp_path, experiment, overrides, departed
):
    rows = [{"run": "full"}, {"run": "full", "label": "C", "variant": "splat"}]
    rows.append({"run": "wo_seg", "label": "w/o S"})
    runs = [
        paper_run(tmp_path / name, model=name) for name in ("full", "wo_seg")
    ]
    for run in runs if experiment else ():
        (run / ".hydra").mkdir()
        held = {
            "runtime": {"choices": {"experiment": experiment}},
            "overrides": {"task": overrides},
        }
        OmegaConf.save({"hydra": held}, run / ".hydra" / "hydra.yaml")
    (grid,) = report_of(
        table(**(ABLATION | VIEW | {"rows": rows})), *runs
    ).grids
    ours = [r.label for r in grid.rows if r.kind != "paper"]
    assert (f"{NAME}, w/o S" in ours) == (departed == "")
    assert ours.count(NAME) == (departed == "")
    notes = " ".join(note for r in grid.rows for note in r.notes)
    assert (f"differs from experiment=paper: {departed}" in notes) == bool(
        departed
    )
    assert ("no config says whether" in notes) == (departed is None)


def test_another_split_is_not_the_papers(tmp_path):
    run = paper_run(tmp_path / "a", splits=("novel_pose",))
    spec = table(**(ABLATION | VIEW | {"splits": ["novel_pose"]}))
    assert (
        "of novel_pose, the paper's of novel_view"
        in report_of(spec, run).grids[-1].remarks[0]
    )


def test_the_six_subjects_beside_ours(tmp_path):
    subjects = ["377", "386", "387", "392", "393", "394"]
    runs = [paper_run(tmp_path / s, data=zju(int(s))) for s in subjects]
    spec = table(**VIEW, subjects=subjects, data="zju_mocap", paper="zju")
    (grid,) = report_of(spec, *runs).grids
    assert texts(row(grid, "GaussianGAN (as printed)")) == [
        "34.16", "36.45", "29.99", "33.23", "31.50", "32.26", "32.94",
    ]  # fmt: skip
    assert texts(row(grid, "full")) == ["30.00"] * 7


@pytest.mark.parametrize("name", ["zju", "thuman4", "ablation", "miou", "slp"])
def test_every_printed_value_is_a_number(name):
    paper = read_paper(name)
    grid = paper.grid("why")
    printed = [c for r in grid.rows for c in r.cells if c.text != "n/a"]
    assert printed
    assert all(float(c.text) > 0 for c in printed)
    assert paper.title in grid.title


def test_an_unknown_entry_is_refused():
    with pytest.raises(ConfigError, match=r"table\.paper=tables.*zju"):
        read_paper("tables")
