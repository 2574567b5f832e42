"""`gsgan.bench trade-off`: front, curves, points and rows in closed form; tiny real trainings."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import pytest
import torch
from commands import TINY, refused
from gsgan.bench.environment import environment
from gsgan.bench.speed_painter import Way
from gsgan.bench.trade_off_files import drawn
from gsgan.bench.trade_off_front import front, steps
from gsgan.bench.trade_off_measure import score
from gsgan.bench.trade_off_plots import within
from gsgan.bench.trade_off_points import Point, Trained, asked, found_runs, standard_run, sweep

from gsgan.bench import trade_off_train
from gsgan.bench.trade_off_report import Report, Row, make_rows
from gsgan.splat import ACCURACY
from gsgan.train.curve import Curve, curve
from gsgan.utils.errors import ConfigError, DataError, GsganError

HEAD = "epoch,step,val/psnr,val/psnr_splat,val/seconds\n"
SMALL = ["repeats=1", "pictures=2", "settings.accuracies=[draft]", "settings.scales=[0.5]"]
NO_FACTORS = [
    f"factors.{name}=null"
    for name in (
        *("points_on_body", "points_per_limb"),
        *("channels_of_F", "supersampling", "generator_width", "model"),
    )
]


@pytest.mark.parametrize(
    ("cost", "quality", "expected"),
    [
        ([1, 2, 3], [1, 2, 3], [0, 1, 2]),
        ([3, 2, 1], [1, 2, 3], [2]),
        ([1, 1], [1, 2], [1]),
        ([2, 1, 2], [5, 5, 6], [1, 2]),
        ([1, 1, 3], [4, 4, 4], [0, 1]),
        ([], [], []),
    ],
)
def test_the_front_is_what_nothing_beats(cost, quality, expected):
    assert sorted(front(cost, quality)) == expected


def test_the_front_agrees_with_its_definition():
    numbers = torch.randint(0, 6, (2, 40), generator=torch.manual_seed(0)).tolist()
    found = set(front(*numbers))
    points = list(zip(*numbers, strict=True))
    for i, (c, q) in enumerate(points):
        beaten = any(a <= c and b >= q and (a < c or b > q) for a, b in points)
        assert (i in found) == (not beaten)


def test_the_step_line_says_what_can_be_had_for_so_much():
    assert steps([1, 3], [5, 9]) == ([1, 3, 3], [5, 5, 9])
    assert steps([], []) == ([], [])


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
    assert [p.name for p in points] == ["base", "size of it 1", "size of it x/y"]
    assert points[2].words == ("p=q", "a.b=x/y")
    assert points[2].folder == tmp_path / "size_of_it-x_y"
    beside = {"n": {"key": "a", "values": [1], "also": ["b=2"]}}
    assert sweep(["p=q"], beside, tmp_path)[1].words == ("p=q", "b=2", "a=1")


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
    runs = found_runs(tmp_path)
    assert {(r.factor, r.label) for r in runs} == {("model", "full"), ("model", "wo_seg")}
    assert len(runs) == 4
    assert standard_run(runs).label == "full"
    with pytest.raises(DataError, match="no finished run"):
        found_runs(tmp_path / "cut_off")


def test_settings_make_one_point_each_and_unknown_ones_are_refused(tmp_path):
    settings = {"accuracies": ["draft"], "precisions": ["bf16-mixed"], "windows": ["whole"]}
    points = asked(tmp_path, {**settings, "scales": [0.5]}, ACCURACY)
    ways = {p.label: p.way for p in points}
    assert ways["draft"].accuracy == ACCURACY["draft"]
    assert ways["bf16-mixed"].precision == "bf16-mixed"
    assert ways["whole picture"].whole
    assert ways["× 0.5"].scale == 0.5
    for wrong in ({"colours": [1]}, {"accuracies": ["best"]}, {"windows": ["half"]}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            asked(tmp_path, wrong, ACCURACY)


def points_of(*names: tuple[str, str]) -> list[Point]:
    return [Point(f, v, Path(f"{f}{v}{i}"), Way()) for i, (f, v) in enumerate(names)]


def test_seeds_become_one_row_and_a_missing_score_no_mean():
    points = points_of(("model", "full"), ("model", "full"), ("model", "wo_seg"))
    scored = {"ssim": 0.5, "edge_f1": 0.5, "memory_mb": 3.0}
    found = [
        {**scored, "psnr": 20.0},
        {**scored, "psnr": 22.0, "psnr_left_out": 1, "memory_mb": 5.0},
        {**scored, "psnr": None, "memory_mb": None},
    ]
    seconds = {points[0].folder: 60.0, points[1].folder: 120.0}
    full, other = make_rows(points, found, [[1.0], [3.0], [2.0]], seconds)
    assert (full.psnr, full.ms, full.memory_mb, full.seconds) == (21.0, 2.0, 5.0, 90.0)
    assert (full.seeds, full.left_out, full.lpips) == (2, 1, None)
    assert (other.psnr, other.memory_mb, other.seconds) == (None, None, None)


def report_of(*rows: Row, quality: str = "psnr", curves: tuple[Curve, ...] = ()) -> Report:
    where = environment(torch.device("cpu"))
    return Report(rows, curves, quality, "lpips", 4, "novel_pose", "base", where, ("a mark",))


def row(label: str, ms: float, psnr: float | None, lpips: float | None = None) -> Row:
    return Row("model", label, psnr, 0.9, 0.8, lpips, 0, ms, ms, ms, 10.0, None, 1)


def test_the_table_marks_the_front_and_lower_lpips_is_better():
    rows = (row("a", 1, 20, 0.3), row("b", 2, 19, 0.1), row("c", 3, None, 0.2))
    table = report_of(*rows).table()
    assert [line.endswith("| yes |") for line in table.splitlines()[2:]] == [True, False, False]
    assert report_of(*rows, quality="lpips").front("lpips") == [0, 1]


def test_what_is_not_had_is_said():
    text = report_of(row("a", 1, 20)).text()
    assert "LPIPS n/a" in text
    assert "no training times" in text
    assert "- a mark" in text


def test_what_is_far_slower_stands_at_the_edge_with_its_time_and_keeps_it_in_the_table():
    rows = [row("a", 10, 20), row("b", 10, 21), row("exact", 5000, 22)]
    assert [r.ms for r in within(rows)] == [10, 10, 80]
    assert within(rows)[2].label == "exact: 5000 ms →"
    assert "5000" in report_of(*rows).table()


def test_pictures_are_drawn_with_and_without_curves_and_scores():
    rows = [row(f"point {i}", 1 + i % 3, 20 + i, None) for i in range(9)]
    assert set(drawn(report_of(*rows))) == {"trade_off.png"}
    curves = (Curve("full", (0, 60), (10, 20)), Curve("full", (0, 50), (10, 21)))
    pictures = drawn(report_of(row("alone", 1, None, 0.2), quality="psnr", curves=curves))
    assert all(png.startswith(b"\x89PNG") for png in pictures.values())
    assert len(pictures) == 2


def test_scores_are_means_of_finite_ones(build):
    _, _, frame = build()
    shown = iter([frame.image, (frame.image + 0.1).clamp(0, 1)])
    found = score(lambda _: next(shown), [frame, frame], None)
    assert found["psnr_left_out"] == 1  # the equal picture's is infinite
    error = ((frame.image + 0.1).clamp(0, 1) - frame.image).square().mean()
    assert math.isclose(found["psnr"], -10 * math.log10(error), rel_tol=1e-5)
    assert 0.5 < found["ssim"] < 1
    assert "lpips" not in found


def test_a_training_that_fails_or_is_cut_off_is_not_done(tmp_path, monkeypatch):
    class Done:
        returncode = 1

    point = Trained("base", "base", ("size=tiny",), tmp_path / "it's")
    monkeypatch.setattr(trade_off_train.subprocess, "run", lambda *a, **k: Done)
    with pytest.raises(GsganError, match="training base ended with 1"):
        trade_off_train.train_all([point], trade_off_train.Console(quiet=True))
    assert not trade_off_train.is_done(point)
    assert f"hydra.run.dir='{tmp_path}/it\\'s'" in trade_off_train.command(point)
    (point.folder / "checkpoints").mkdir(parents=True)
    (point.folder / "checkpoints" / "last.ckpt").write_bytes(b"weights")
    Done.returncode = 0
    trade_off_train.train_all([point], trade_off_train.Console(quiet=True))
    assert trade_off_train.is_done(point)
    (point.folder / "checkpoints" / "last.ckpt").write_bytes(b"others")
    assert not trade_off_train.is_done(point)


def test_the_command_trains_a_sweep_and_goes_on_where_it_stopped(capture, tmp_path, inside):
    out = tmp_path / "out"
    words = ",".join(f"'{w}'" for w in [*TINY, f"data.root={capture}"])
    given = [f"base=[{words}]", *NO_FACTORS, *SMALL]
    given += ["settings.backends=[]", f"hydra.run.dir={out}", "patience=100"]
    first = inside("bench", "trade-off", *given)
    assert first.returncode == 0, first.stderr + first.stdout
    found = json.loads((out / "trade_off.json").read_text())
    labels = [r["label"] for r in found["rows"]]
    assert labels == ["base", "draft", "bf16-mixed", "× 0.5", "whole picture"]
    assert all(r["psnr"] > 5 and r["ms"] > 0 for r in found["rows"])
    assert found["rows"][0]["seconds"] > 0
    assert (out / "trade_off_training.png").is_file()
    assert not (out / "runs" / "base" / "metrics.json").exists()  # scoring is the bench's
    lines = (out / "measurements.jsonl").read_text().splitlines()
    again = inside("bench", "trade-off", *given)
    assert again.returncode == 0, again.stderr
    assert "training 1 of" not in again.stdout
    assert (out / "measurements.jsonl").read_text().splitlines() == lines
    assert json.loads((out / "trade_off.json").read_text())["rows"] == found["rows"]


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
    done = inside("bench", "trade-off", *given, f"docs={page}", "settings.backends=[]")
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
