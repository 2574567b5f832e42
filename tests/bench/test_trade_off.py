"""`gsgan.bench trade-off`: front, curves, points and rows in closed form; a multirun of two."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import pandas as pd
import pytest
from commands import refused

from gsgan.bench.painter import Way
from gsgan.bench.trade_off import (
    Point,
    front,
    make_rows,
    plot,
    quality,
    runs_in,
    standard_run,
    table,
    text,
    ways,
)
from gsgan.report.training_curve import Curve, curve
from gsgan.splat import ACCURACY
from gsgan.utils.errors import ConfigError, DataError

WHERE = {"device": "cpu", "hardware": "Abacus", "threads": 1, "date": "", "load": None}
WHERE |= {"versions": {}}
HEAD = "epoch,step,val/psnr,val/psnr_splat,val/seconds\n"
SMALL = ["repeats=1", "pictures=1", "settings.accuracies=[draft]", "settings.scales=[0.5]"]


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
    with pytest.raises(ConfigError, match=r"settings.accuracies must be one of .* got 'best'"):
        ways(tmp_path, {"accuracies": ["best"]}, ACCURACY)


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
    page = text(rows_of(("a", 1, 20)), "psnr", about, WHERE, ["a mark"])
    assert "LPIPS n/a" in page
    assert "- a mark" in page


def test_the_plot_is_drawn_with_and_without_scores():
    frame = rows_of(*((f"point {i}", 1 + i % 3, 20 + i) for i in range(9)))
    for rows in (frame, rows_of(("alone", 1, None), lpips=0.2), rows_of(("none", 1, None))):
        assert plot(rows, ["psnr", "lpips"]).startswith(b"\x89PNG")


def test_scores_are_means_of_finite_ones(build):
    _, _, frame = build()
    shown = iter([frame.image, (frame.image + 0.1).clamp(0, 1)])
    found = quality(lambda _: next(shown), [frame, frame], None)
    assert found["left_out"] == 1  # the equal image's PSNR is infinite
    error = ((frame.image + 0.1).clamp(0, 1) - frame.image).square().mean()
    assert math.isclose(found["psnr"], -10 * math.log10(error), rel_tol=1e-5)
    assert 0.5 < found["ssim"] < 1
    assert "lpips" not in found


@pytest.mark.slow
def test_the_command_compares_a_multirun(run, tmp_path, inside):
    for name in ("one", "two"):
        shutil.copytree(run, tmp_path / "sweep" / name)
    words = tmp_path / "sweep" / "two" / ".hydra" / "overrides.yaml"
    words.write_text(words.read_text() + "- twist=odd\n")
    fake_run(tmp_path / "sweep", "three", finished=False)
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("<!-- bench:trade-off -->\nold\n<!-- end -->\n")
    given = [f"runs={tmp_path / 'sweep'}", *SMALL, f"hydra.run.dir={tmp_path / 'out'}"]
    given += ["settings.backends=[]", "settings.precisions=[]"]
    done = inside("bench", "trade-off", *given, f"docs={page}")
    assert done.returncode == 0, done.stderr
    assert "left out, not finished: three" in done.stdout
    assert "| twist | odd |" in page.read_text()
    assert (page.parent / "pictures" / "trade_off.png").is_file()
    found = json.loads((tmp_path / "out" / "trade_off.json").read_text())["rows"]
    labels = [row["label"] for row in found]
    assert labels == ["base", "odd", "draft", "× 0.5", "whole picture"]
    assert all(row["psnr"] > 5 and row["ms"] > 0 for row in found)
    assert found[0]["seconds"] > 0
    config = tmp_path / "sweep" / "two" / ".hydra" / "config.yaml"
    config.write_text(config.read_text().replace("size: 32", "size: 16"))
    refused(inside("bench", "trade-off", *given), "two", "other data")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["run=a", "runs=b"], ["either run="]),
        ([], ["either run="]),
        (["run=/nowhere"], ["/nowhere", "not a run folder"]),
        (["runs=/nowhere"], ["/nowhere", "no finished run"]),
        (["repeats=0"], ["repeats"]),
        (["pictures=none"], ["pictures"]),
        (["patience=0"], ["patience"]),
        (["quality=beauty"], ["quality", "psnr"]),
        (["split=train"], ["split"]),
        (["docs=/nowhere.md"], ["/nowhere.md"]),
    ],
)
def test_what_makes_no_sense_ends_in_one_sentence(inside, given, words):
    refused(inside("bench", "trade-off", *given), *words)
