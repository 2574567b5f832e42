"""`gsgan.bench trade-off`: front, curves, points and rows in closed form; tiny real trainings."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import pandas as pd
import pytest
from commands import TINY, refused

from gsgan.bench import common
from gsgan.bench.painter import Way
from gsgan.bench.trade_off import (
    Point,
    make_rows,
    quality,
    runs_in,
    standard_run,
    sweep,
    ways,
)
from gsgan.bench.trade_off_report import front, images, table, text
from gsgan.report.curve import Curve, curve
from gsgan.splat import ACCURACY
from gsgan.utils.errors import ConfigError, DataError

WHERE = {"device": "cpu", "hardware": "Abacus", "threads": 1, "date": "", "load": None}
WHERE |= {"versions": {}}
HEAD = "epoch,step,val/psnr,val/psnr_splat,val/seconds\n"
SMALL = ["repeats=1", "pictures=2", "settings.accuracies=[draft]", "settings.scales=[0.5]"]
NO_FACTORS = [
    f"factors.{name}=null"
    for name in (
        *("points_on_body", "points_per_limb"),
        *("channels_of_F", "supersampling", "generator_width", "model"),
    )
]


def rows_of(*rows: tuple[str, float, float | None], lpips: float = math.nan) -> pd.DataFrame:
    found = []
    for label, ms, psnr in rows:
        scores = {"psnr": psnr, "ssim": 0.9, "edge_f1": 0.8, "lpips": lpips, "left_out": 0}
        times = {"ms": ms, "p10": ms, "p90": ms, "memory_mb": 10.0, "seconds": math.nan}
        found.append({"factor": "model", "label": label, **scores, **times, "seeds": 1})
    return pd.DataFrame(found)


@pytest.mark.parametrize(
    ("cost", "score", "expected"),
    [
        ([1, 2, 3], [1, 2, 3], [0, 1, 2]),
        ([3, 2, 1], [1, 2, 3], [2]),
        ([1, 1], [1, 2], [1]),
        ([2, 1, 2], [5, 5, 6], [1, 2]),
        ([1, 1, 3], [4, 4, 4], [0, 1]),
        ([1, 2], [math.nan, 1], [1]),
    ],
)
def test_the_front_is_what_nothing_beats(cost, score, expected):
    frame = rows_of(*zip("abc", cost, score, strict=False))
    assert front(frame, "psnr") == expected


def write_log(run: Path, name: str, rows: list[tuple[float, float]], end: str = "") -> None:
    folder = run / name
    folder.mkdir(parents=True)
    lines = "".join(f"0,0,{psnr},,{seconds}\n" for seconds, psnr in rows)
    (folder / "metrics.csv").write_text(HEAD + "0,3,,,\n" + lines + end)


def test_a_curve_joins_the_parts_of_a_resumed_run(tmp_path):
    write_log(tmp_path, "logs", [(0, 10), (5, 20), (9, 22)], end="0,0,2")  # cut off by a kill
    write_log(tmp_path, "logs_000040", [(8, 21), (12, 25)])
    assert curve("full", tmp_path) == Curve("full", (0, 5, 8, 12), (10, 20, 21, 25))


def test_a_log_without_seconds_gives_no_curve(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "metrics.csv").write_text("epoch,step,val/psnr\n0,0,10\n1,4,12\n")
    assert curve("full", tmp_path) is None
    assert curve("full", tmp_path / "nowhere") is None


def test_a_training_logs_how_long_it_took(run):
    found = curve("full", run)
    assert found is not None
    assert found.seconds[0] == 0
    assert found.seconds[-1] > 0


def test_a_sweep_changes_one_thing_at_a_time(tmp_path):
    factors = {"size_of_it": {"key": "a.b", "values": [1, "x/y"]}, "none": None}
    points = sweep(["p=q"], factors, tmp_path)
    assert [(p.factor, p.label) for p in points] == [
        *(("base", "base"), ("size of it", "1"), ("size of it", "x/y"))
    ]
    assert points[2].overrides == ("p=q", "a.b=x/y", "evaluate=false")
    assert points[2].folder == tmp_path / "size_of_it-x_y"
    beside = {"n": {"key": "a", "values": [1], "also": ["b=2"]}}
    assert sweep(["p=q"], beside, tmp_path)[1].overrides[:3] == ("p=q", "b=2", "a=1")


@pytest.mark.parametrize(
    "factors", [{"a": 3}, {"a": {"key": "b"}}, {"a": {"key": "b", "values": [1, 1]}}]
)
def test_a_factor_that_makes_no_sense_is_refused(factors, tmp_path):
    with pytest.raises(ConfigError, match="a"):
        sweep([], factors, tmp_path)


def fake_run(folder: Path, name: str, *words: str, finished: bool = True) -> Path:
    run = folder / name
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "last.ckpt").write_bytes(b"")
    (run / ".hydra").mkdir()
    (run / ".hydra" / "overrides.yaml").write_text(json.dumps(list(words)))
    if finished:
        (run / "metrics.json").write_text("{}")
    return run


def test_runs_are_named_by_what_tells_them_apart(tmp_path):
    for model in ("full", "wo_seg"):
        for seed in (0, 1):
            words = ("experiment=x", f"model={model}", f"seed={seed}", "data.source.workers=1")
            fake_run(tmp_path, f"{model}{seed}", *words)
    fake_run(tmp_path, "cut_off", "experiment=x", "model=wo_gcn", finished=False)
    runs, unfinished = runs_in(tmp_path)
    assert unfinished == ["cut_off"]
    assert {(r.factor, r.label) for r in runs} == {("model", "full"), ("model", "wo_seg")}
    assert len(runs) == 4
    assert standard_run(runs).label == "full"
    with pytest.raises(DataError, match="no finished run"):
        runs_in(tmp_path / "cut_off")


def test_settings_make_one_point_each_and_unknown_ones_are_refused(tmp_path):
    settings = {"accuracies": ["draft"], "precisions": ["bf16-mixed"], "windows": ["whole"]}
    points = ways(tmp_path, {**settings, "scales": [0.5]}, ACCURACY)
    found = {p.label: p.way for p in points}
    assert found["draft"].accuracy == ACCURACY["draft"]
    assert found["bf16-mixed"].precision == "bf16-mixed"
    assert found["whole picture"].whole
    assert found["× 0.5"].scale == 0.5
    for wrong in ({"colours": [1]}, {"accuracies": ["best"]}, {"windows": ["half"]}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            ways(tmp_path, wrong, ACCURACY)


def points_of(*names: tuple[str, str]) -> list[Point]:
    return [Point(f, v, Path(f"{f}{v}{i}"), Way()) for i, (f, v) in enumerate(names)]


def test_seeds_become_one_row_and_a_missing_score_no_mean():
    points = points_of(("model", "full"), ("model", "full"), ("model", "wo_seg"))
    scored = {"ssim": 0.5, "edge_f1": 0.5, "memory_mb": 3.0, "left_out": 0}
    found = [
        {**scored, "psnr": 20.0},
        {**scored, "psnr": 22.0, "left_out": 1, "memory_mb": 5.0},
        {**scored, "psnr": None, "memory_mb": None},
    ]
    seconds = {points[0].folder: 60.0, points[1].folder: 120.0}
    frame = make_rows(points, found, [[1.0], [3.0], [2.0]], seconds)
    full, other = frame.to_dict("records")
    assert (full["psnr"], full["ms"], full["memory_mb"], full["seconds"]) == (21.0, 2.0, 5.0, 90.0)
    assert (full["seeds"], full["left_out"]) == (2, 1)
    assert math.isnan(full["lpips"])
    assert all(math.isnan(other[name]) for name in ("psnr", "memory_mb", "seconds"))


def test_the_table_marks_the_front_and_lower_lpips_is_better():
    frame = rows_of(("a", 1, 20), ("b", 2, 19), ("c", 3, None)).assign(lpips=[0.3, 0.1, 0.2])
    lines = table(frame, "psnr").splitlines()[2:]
    assert [line.endswith("| yes |") for line in lines] == [True, False, False]
    assert front(frame, "lpips") == [0, 1]


def test_what_is_missing_is_noted():
    about = {"pictures": 4, "split": "novel_pose", "subject": "base"}
    page = text(rows_of(("a", 1, 20)), "psnr", about, WHERE, ["a mark"], has_curves=False)
    assert "LPIPS n/a" in page
    assert "no training times" in page
    assert "- a mark" in page


def test_plots_are_drawn_with_and_without_curves_and_scores():
    frame = rows_of(*((f"point {i}", 1 + i % 3, 20 + i) for i in range(9)))
    assert set(images(frame, "psnr", "lpips", [])) == {"trade_off.png"}
    curves = [Curve("full", (0, 60), (10, 20)), Curve("full", (0, 50), (10, 21))]
    found = images(rows_of(("alone", 1, None), lpips=0.2), "psnr", "lpips", curves)
    assert all(png.startswith(b"\x89PNG") for png in found.values())
    assert len(found) == 2


def test_scores_are_means_of_finite_ones(build):
    _, _, frame = build()
    shown = iter([frame.image, (frame.image + 0.1).clamp(0, 1)])
    found = quality(lambda _: next(shown), [frame, frame], None)
    assert found["left_out"] == 1  # the equal image's PSNR is infinite
    error = ((frame.image + 0.1).clamp(0, 1) - frame.image).square().mean()
    assert math.isclose(found["psnr"], -10 * math.log10(error), rel_tol=1e-5)
    assert 0.5 < found["ssim"] < 1
    assert "lpips" not in found


def test_the_command_trains_a_sweep_and_goes_on_where_it_stopped(
    run, capture, tmp_path, inside, monkeypatch
):
    started = []

    def launch(arguments, log):  # a training is tested elsewhere: a finished run stands in
        started.append(arguments)
        shutil.copytree(run, log.with_suffix(""), dirs_exist_ok=True)
        return 0

    monkeypatch.setattr(common, "launch", launch)
    out = tmp_path / "out"
    words = ",".join(f"'{w}'" for w in [*TINY, f"data.root={capture}"])
    given = [f"base=[{words}]", *NO_FACTORS, *SMALL]
    given += ["settings.backends=[]", f"hydra.run.dir={out}", "patience=100"]
    first = inside("bench", "trade-off", *given)
    assert first.returncode == 0, first.stderr + first.stdout
    assert "training 1 of 1: base" in first.stdout
    assert started[0][-2:] == ["evaluate=false", f"hydra.run.dir='{out / 'runs' / 'base'}'"]
    found = json.loads((out / "trade_off.json").read_text())
    labels = [r["label"] for r in found["rows"]]
    assert labels == ["base", "draft", "bf16-mixed", "× 0.5", "whole picture"]
    assert all(r["psnr"] > 5 and r["ms"] > 0 for r in found["rows"])
    assert found["rows"][0]["seconds"] > 0
    assert (out / "trade_off_training.png").is_file()
    lines = (out / "measurements.jsonl").read_text().splitlines()
    again = inside("bench", "trade-off", *given)
    assert again.returncode == 0, again.stderr
    assert (out / "measurements.jsonl").read_text().splitlines() == lines
    scores = [row["psnr"] for row in json.loads((out / "trade_off.json").read_text())["rows"]]
    assert scores == [row["psnr"] for row in found["rows"]]


def test_the_command_takes_a_sweep_that_there_is(run, tmp_path, inside):
    for name in ("one", "two"):
        shutil.copytree(run, tmp_path / "sweep" / name)
    words = tmp_path / "sweep" / "two" / ".hydra" / "overrides.yaml"
    words.write_text(words.read_text() + "- twist=odd\n")
    fake_run(tmp_path / "sweep", "three", finished=False)
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("<!-- bench:trade-off -->\nold\n<!-- end -->\n")
    given = [f"runs={tmp_path / 'sweep'}", *SMALL, f"hydra.run.dir={tmp_path / 'out'}"]
    given += [f"settings.{name}=[]" for name in ("accuracies", "precisions", "backends", "windows")]
    done = inside("bench", "trade-off", *given, f"docs={page}")
    assert done.returncode == 0, done.stderr
    assert "left out, not finished: three" in done.stdout
    assert "| twist | odd |" in page.read_text()
    assert (page.parent / "pictures" / "trade_off.png").is_file()
    config = tmp_path / "sweep" / "two" / ".hydra" / "config.yaml"
    config.write_text(config.read_text().replace("size: 32", "size: 16"))
    refused(inside("bench", "trade-off", *given), "two", "other data")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["run=a", "runs=b"], ["not both"]),
        (["run=/nowhere"], ["/nowhere", "last.ckpt"]),
        (["runs=/nowhere"], ["/nowhere", "no finished run"]),
        (["repeats=0"], ["repeats"]),
        (["pictures=none"], ["pictures"]),
        (["patience=0"], ["patience"]),
        (["quality=beauty"], ["quality", "psnr"]),
        (["split=train"], ["split"]),
        (["settings.scales=[0]"], ["scale"]),
        (["settings.precisions=[int8]"], ["precision"]),
        (["factors.model=3"], ["factors.model"]),
        (["docs=/nowhere.md"], ["/nowhere.md"]),
    ],
)
def test_what_makes_no_sense_ends_in_one_sentence_before_training(inside, given, words):
    refused(inside("bench", "trade-off", *given), *words)
