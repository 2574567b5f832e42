"""Tables of handmade runs: every number in closed form, every mixture refused by name."""

import json

import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf
from report_folders import (
    protocol,
    report_of,
    row,
    table,
    texts,
    variant,
    write_run,
    zju,
)

from gsgan.report.spec import format_value
from gsgan.utils.config import config_folder
from gsgan.utils.errors import ConfigError

SPLITS = ("novel_view", "novel_pose")


def seeds(tmp_path, model="full", values=(30.0, 32.0, 31.0), **held):
    return [
        write_run(tmp_path / f"{model}{seed}", model, seed, psnr=value, **held)
        for seed, value in enumerate(values)
    ]


def test_mean_spread_seeds_and_floor(tmp_path):
    report = report_of(table(), *seeds(tmp_path))
    (grid,) = report.grids
    full = row(grid, "full")
    assert texts(full) == ["31.00 ± 1.00", "n/a"]
    assert full.cells[1].notes == ("n/a: left out by lpips.nets",)
    assert (full.cells[0].mean, full.cells[0].spread) == (
        31.0,
        1.0,
    )  # divided by n - 1
    assert full.origin == ("3", "synthetic, person", "none", "abc123")
    floor = row(grid, "all background (floor)")
    assert (texts(floor), floor.kind) == (["15.50", "n/a"], "floor")
    assert floor.cells[0].spread is None  # one value for all seeds


def test_the_deviation_over_poses_stands_in_brackets(tmp_path):
    folders = seeds(tmp_path)
    for deviation, folder in enumerate(folders, start=1):
        path = folder / "metrics.json"
        scores = json.loads(path.read_text())
        for variants in scores.values():
            variants["full"]["psnr_over_poses"] = float(deviation)
        path.write_text(json.dumps(scores))
    report = report_of(table(), *folders)
    cell = row(report.grids[0], "full").cells[0]
    assert cell.text == "31.00 ± 1.00 (2.00)"
    assert (cell.mean, cell.spread) == (31.0, 1.0)
    assert "over poses" in report.grids[0].remarks[0]


def test_a_value_that_some_seeds_lack_is_counted_and_explained(tmp_path):
    runs = [*seeds(tmp_path, values=(30.0, 31.0), lpips_vgg=0.1)]
    runs.append(write_run(tmp_path / "x", "full", 2, psnr=32.0))
    full = row(report_of(table(), *runs).grids[0], "full")
    assert texts(full) == ["31.00 ± 1.00", "0.1000 ± 0.0000"]
    assert full.cells[1].notes == ("seed 2: left out by lpips.nets",)


def test_marks_departures_and_left_out_images_are_noted(tmp_path):
    record = protocol(
        "zju_humannerf", departures=["background is black, asked for: white"]
    )
    report = report_of(
        table(),
        write_run(
            tmp_path / "a",
            psnr=30.0,
            psnr_left_out=2,
            marks=["stand-in"],
            record=record,
        ),
    )
    full = row(report.grids[0], "full")
    assert full.notes == (
        "marked: stand-in",
        "departs from zju_humannerf: background is black, asked for: white",
    )
    assert full.cells[0].notes == (
        "2 images without a finite score are not in the mean",
    )


def test_the_best_of_several_rows_is_emphasised(tmp_path):
    lower = {"lpips_vgg": 0.1, "lpips_input": "[-1,1]", "edge_ratio": 1.2}
    runs = [
        write_run(tmp_path / "a", "a", psnr=30.0, **lower),
        write_run(
            tmp_path / "b",
            "b",
            psnr=31.0,
            **(lower | {"lpips_vgg": 0.2, "edge_ratio": 0.9}),
        ),
    ]
    (grid,) = report_of(
        table(metrics=["psnr", "lpips_vgg", "edge_ratio"]), *runs
    ).grids
    found = {r.label: [cell.best for cell in r.cells] for r in grid.rows}
    assert found == {
        "a": [False, True, False],
        "b": [True, False, True],
        "all background (floor)": [False] * 3,
    }


def test_no_share_is_the_best(tmp_path):
    runs = [
        write_run(tmp_path / name, name, error_outline=share)
        for name, share in (("a", 0.4), ("b", 0.6))
    ]
    (grid,) = report_of(table(metrics=["error_outline"]), *runs).grids
    assert grid.columns == ["error, outline"]
    assert not any(cell.best for row in grid.rows for cell in row.cells)


def test_step_ones_colour_is_a_row_of_its_own(tmp_path):
    run = write_run(tmp_path / "a", psnr=30.0, splat={"psnr": 29.0})
    grid = report_of(table(variants=["full", "splat"]), run).grids[0]
    assert [r.label for r in grid.rows] == [
        "full", "full: Step I's colour", "all background (floor)",
    ]  # fmt: skip
    assert texts(row(grid, "full: Step I's colour")) == ["29.00", "n/a"]


def test_the_table_of_signs_has_boxes_of_one_kind(tmp_path):
    spec = instantiate(OmegaConf.load(config_folder() / "table" / "slp.yaml"))
    boxes = "skeleton holistic; hands: their landmarks"
    runs = [
        write_run(
            tmp_path / model, model, psnr=psnr, psnr_hands=psnr - 6, boxes=boxes
        )
        for model, psnr in (
            ("full", 33.0),
            ("image_to_image", 29.0),
            ("splat_only", 32.0),
        )
    ]
    ours, paper = report_of(spec, *runs).grids
    # no empty row for a model without a run
    models = ["full", "image_to_image", "splat_only"]
    assert [r.label for r in ours.rows] == [*models, "all background (floor)"]
    assert texts(row(ours, "full"))[:2] == ["33.00", "27.00"]
    assert ours.remarks[1] == f"Boxes: {boxes}."
    assert "the paper's capture is private" in paper.remarks[0]
    other = write_run(
        tmp_path / "x", "lbs_splat", psnr=30.0, boxes=boxes.replace("ho", "o")
    )
    with pytest.raises(ConfigError, match="boxes of hands and mouth"):
        report_of(spec, *runs, other)
    (grid,) = report_of(
        table(), *runs, other
    ).grids  # which shows no score of boxes
    assert len(grid.remarks) == 1


MIXTURES = {
    "other data": (
        {"data": {"name": "capture", "root": "me"}},
        "data",
    ),
    "other fingerprint": (
        {
            "data": {
                "name": "synthetic",
                "root": "person",
                "fingerprint": "beef",
            }
        },
        "f00d and beef",
    ),
    "a protocol": (
        {"record": protocol("paper_zju")},
        "protocol.*none and paper_zju",
    ),
    "other images": (
        {"floor": {"psnr": 15.6}},
        r"15\.5 and 15\.6",
    ),
    "fewer images": ({"images": 2}, "3 and 2"),
    "changed code": ({"facts": {"dirty": True}}, "uncommitted changes"),
    "another LPIPS": (
        {"lpips_vgg": 0.1, "lpips_input": "[0,1]"},
        r"\[-1,1\] and \[0,1\]",
    ),
}


@pytest.mark.parametrize(("held", "message"), MIXTURES.values(), ids=MIXTURES)
def test_runs_that_do_not_belong_in_one_column_are_refused_by_name(
    tmp_path, held, message
):
    first = write_run(
        tmp_path / "first", psnr=30.0, lpips_vgg=0.2, lpips_input="[-1,1]"
    )
    other = write_run(tmp_path / "other", "wo_seg", psnr=29.0, **held)
    with pytest.raises(ConfigError, match=message) as caught:
        report_of(table(), first, other)
    assert str(first) in str(caught.value)
    assert str(other) in str(caught.value)


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ({"marks": ["stand-in"]}, "marks.*none and stand-in"),
        (
            {"record": protocol("p", scale=1.0)},
            "protocol.*scale",
        ),
    ],
)
def test_seeds_of_one_row_must_match(tmp_path, held, message):
    first = {"record": protocol("p")} if "record" in held else {}
    runs = [write_run(tmp_path / "a", psnr=30.0, **first)]
    runs.append(write_run(tmp_path / "b", seed=1, **({"psnr": 30.0} | held)))
    with pytest.raises(ConfigError, match=message):
        report_of(table(), *runs)


def test_every_pair_of_seeds_is_compared(tmp_path):
    """One that does not tell its iterations must not hide that two others differ."""
    runs = [
        write_run(
            tmp_path / str(seed),
            seed=seed,
            psnr=30.0,
            facts={"iterations": done},
        )
        for seed, done in enumerate((7000, None, 10))
    ]
    with pytest.raises(ConfigError, match="7000 and 10"):
        report_of(table(), *runs)


def test_a_method_of_a_models_name_is_not_pooled_with_it(tmp_path):
    model = write_run(tmp_path / "a", psnr=30.0)
    facts = {"method": "full", "iterations": None}
    method = write_run(tmp_path / "b", None, None, psnr=20.0, facts=facts)
    with pytest.raises(
        ConfigError,
        match="predictions",
    ):
        report_of(table(), model, method)


def test_one_seed_twice_is_refused(tmp_path):
    runs = [write_run(tmp_path / name, psnr=30.0) for name in ("a", "again")]
    with pytest.raises(
        ConfigError,
        match=r"a \(full, seed 0\).*again \(full, seed 0\)",
    ):
        report_of(table(), *runs)


@pytest.mark.parametrize(
    ("facts", "commits"),
    [
        ({"commit": "def456"}, "abc123, def456"),
        ({"dirty": True}, "abc123, abc123 + changes"),
    ],
)
def test_several_commits_stand_together_and_changed_code_where_allowed(
    tmp_path, facts, commits
):
    runs = [write_run(tmp_path / "a", psnr=30.0)]
    runs.append(write_run(tmp_path / "b", seed=1, psnr=30.0, facts=facts))
    report = report_of(table(), *runs, allow_dirty=True)
    assert row(report.grids[0], "full").origin[3] == commits


def test_one_grid_takes_runs_that_scored_other_splits(tmp_path):
    both = write_run(
        tmp_path / "a", psnr=30.0, record=protocol("p"), splits=SPLITS
    )
    one = write_run(
        tmp_path / "b",
        "wo_seg",
        psnr=29.0,
        record=protocol("p"),
        splits=SPLITS[:1],
    )
    grids = report_of(table(splits=SPLITS), both, one).grids
    assert len(grids) == 2
    assert [r.label for r in grids[0].rows] == [
        "full",
        "wo_seg",
        "all background (floor)",
    ]
    assert [r.label for r in grids[1].rows] == [
        "full",
        "all background (floor)",
    ]


def test_runs_of_other_rows_are_named_and_left_out(tmp_path):
    runs = [
        write_run(tmp_path / "a", psnr=30.0),
        write_run(tmp_path / "b", "mine", psnr=30.0),
    ]
    report = report_of(table(rows=[{"run": "full"}]), *runs)
    assert report.left_out == {"b": "table t has no row for mine"}
    with pytest.raises(ConfigError, match=" mine"):
        report_of(table(rows=[{"run": "full"}]), runs[1])


def test_a_split_that_no_run_scored_is_refused(tmp_path):
    run = write_run(tmp_path / "a", psnr=30.0)
    with pytest.raises(ConfigError, match="novel_view"):
        report_of(table(splits=["novel_view"]), run)
    held = {"novel_view": {"full": variant(0, psnr_reason="none is held out")}}
    (run / "metrics.json").write_text(json.dumps(held))
    with pytest.raises(ConfigError, match="novel_view"):
        report_of(table(splits=["novel_view"]), run)


SUBJECTS = {
    "subjects": ["377", "386"],
    "metrics": ["psnr"],
    "data": "zju_mocap",
}


def test_subjects_are_columns_with_a_mean_over_them_by_seed(tmp_path):
    runs = [
        write_run(
            tmp_path / f"{s}_{seed}",
            "full",
            seed,
            data=zju(s),
            psnr=30.0 + k + 2 * seed,
        )
        for k, s in enumerate((377, 386))
        for seed in (0, 1)
    ]
    (grid,) = report_of(table(**SUBJECTS), *runs).grids
    assert grid.columns == ["377", "386", "mean"]
    full = row(grid, "full")
    assert texts(full) == ["31.00 ± 1.41", "32.00 ± 1.41", "31.50 ± 1.41"]
    assert full.origin[:2] == ("2", "zju_mocap, 2 subjects")
    assert texts(row(grid, "all background (floor)")) == ["15.50"] * 3


def test_subjects_of_other_seeds_have_no_mean(tmp_path):
    for subject, seeds in ((377, (0, 1)), (386, (0,))):
        for seed in seeds:
            write_run(
                tmp_path / f"{subject}_{seed}",
                seed=seed,
                data=zju(subject),
                psnr=30.0 + 2 * seed,
            )
    full = row(report_of(table(**SUBJECTS), tmp_path).grids[0], "full")
    assert texts(full) == ["31.00 ± 1.41", "30.00", "n/a"]
    assert "not all have scores of these seeds" in full.cells[2].notes[0]
    assert full.origin[0] == "1 to 2"


def test_other_subjects_are_left_out_and_other_data_refused(tmp_path):
    one = write_run(tmp_path / "a", data=zju(377), psnr=30.0)
    other = write_run(tmp_path / "b", data=zju(313), psnr=30.0)
    assert report_of(table(**SUBJECTS), one, other).left_out.keys() == {"b"}
    synthetic = write_run(tmp_path / "c", psnr=30.0)
    with pytest.raises(
        ConfigError, match=r"zju_mocap.*c \(full, seed 0\).* synth"
    ):
        report_of(table(**SUBJECTS), one, synthetic)


def test_a_mean_over_subjects_refuses_other_protocols(tmp_path):
    one = write_run(
        tmp_path / "a",
        data=zju(377),
        psnr=30.0,
        record=protocol("p", subject=377),
    )
    two = write_run(
        tmp_path / "b",
        data=zju(386),
        psnr=30.0,
        record=protocol("p", subject=386),
    )
    report_of(table(**SUBJECTS), one, two)  # the subject is theirs to differ in
    three = write_run(
        tmp_path / "c", data=zju(386), seed=1, psnr=30.0, record=protocol("q")
    )
    with pytest.raises(ConfigError, match="p and q"):
        report_of(table(**SUBJECTS), one, three)


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.006, "1.01"), (-1.5, "−1.50"), (-0.001, "0.00"), (2.0, "2.00")],
)
def test_signs_and_digits(value, text):
    assert format_value("psnr", value) == text


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("metrics", [], "metrics"),
        ("metrics", ["fid"], "metrics.*psnr, .*'fid'"),
        (
            "splits",
            "novel_pose",
            "splits.*train, novel_view, novel_pose",
        ),
        (
            "variants",
            ["floor"],
            "variants.*full, splat.*'floor'",
        ),
        (
            "rows",
            [{"run": "full", "variant": "floor"}],
            "variants",
        ),
    ],
)
def test_a_wrong_value_is_refused_by_key(key, value, message):
    with pytest.raises(ConfigError, match=f"table.{message}"):
        table(**{key: value})
