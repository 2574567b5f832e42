"""The scripts of scripts/bench run tiny and write their tables."""

import json
import runpy
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch
from commands import ROOT
from omegaconf import OmegaConf

from gsgan.utils.errors import GsganError

SCRIPTS = ROOT / "scripts" / "bench"
SCENE = [
    "size=tiny",
    "data.source.frames=2",
    "data.source.test_frames=1",
    "data.body=none",
    "data.source.train_cameras=2",
    "data.source.test_cameras=1",
    "data.source.rays_per_pixel=1",
]


@pytest.fixture
def script(monkeypatch, tmp_path):
    """Runs a script with ``key=value`` arguments; returns its message, "" if it succeeded."""
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    monkeypatch.chdir(tmp_path)

    def call(name: str, *arguments: str) -> str:
        monkeypatch.setattr(
            sys, "argv", [name, f"out={tmp_path / 'out'}", *arguments]
        )
        try:
            runpy.run_path(str(SCRIPTS / f"{name}.py"), run_name="__main__")
        except SystemExit as end:
            return str(end.code)
        return ""

    return call


def read(folder: Path, name: str) -> dict:
    assert (folder / "out" / f"{name}.md").is_file()
    return json.loads((folder / "out" / f"{name}.json").read_text())


def test_raster_measures_time_and_error(script, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:raster -->\nold\n<!-- end -->\n")
    grid = [
        "gaussians=[300]",
        "channels=[3]",
        "sizes=[64]",
        "exact_upto.torch=300",
        "repeats=1",
    ]
    assert not script("raster", *grid, "windows=2", "window=16", f"docs={page}")
    rows = pd.DataFrame(read(tmp_path, "raster")["rows"]).query(
        "backend == 'torch'"
    )
    worst = rows.set_index("setting").value_max
    assert worst["exact"] < 1e-6 < worst["high"] < worst["draft"]
    assert (rows[["forward_ms", "both_ms"]] > 0).all(axis=None)
    assert "| torch | draft |" in page.read_text()


def test_roofline_measures_each_stage(script, tmp_path, capture):
    words = ["sizes=[tiny]", "frames=1", "warmup=0", "poses=1"]
    assert not script("roofline", *words, f"speed=[data.root={capture}]")
    table = pd.read_csv(tmp_path / "out" / "roofline.csv").set_index("stage")
    assert (table.drop("paste")[["flop", "bytes"]] > 0).all(axis=None)
    assert table.loc["UNet", "flop"] < table.loc["end to end", "flop"]


def test_surface_measures_each_part(script, tmp_path):
    clips = ["train=[choreography:5]", "test=[held@far:2]"]
    assert not script("surface", *clips, "points=400")
    table = read(tmp_path, "surface")
    assert set(table) == {"training", "held"}
    assert all(0.5 < table[name]["chest"] < 40 for name in table)
    assert table["training"]["landmarks, median"] < 5
    training = table["training"]
    assert training["all, less linear offsets"] < 0.8 * training["all"]


@pytest.mark.slow
def test_trade_off_compares_a_multirun(script, tmp_path, run, capture):
    for name in ("one", "two"):
        shutil.copytree(run, tmp_path / "sweep" / name)
    words = tmp_path / "sweep" / "two" / ".hydra" / "overrides.yaml"
    words.write_text(words.read_text() + "- twist=odd\n")
    given = [
        f"runs={tmp_path / 'sweep'}",
        "repeats=1",
        "images=1",
        "settings.scales=[0.5]",
    ]
    given.append(f"far_root={capture}")
    given += [
        "settings.accuracies=[draft]",
        "settings.backends=[]",
        "settings.precisions=[]",
    ]
    assert not script("trade_off", *given)
    found = read(tmp_path, "trade_off")["rows"]
    assert [row["label"] for row in found] == [
        "base",
        "odd",
        "draft",
        "× 0.5",
        "whole image",
    ]
    assert all(row["psnr"] > 5 and row["ms"] > 0 for row in found)
    # the same capture
    assert all(row["far"] == pytest.approx(row["psnr"]) for row in found)
    assert (tmp_path / "out" / "trade_off.png").is_file()
    assert "give either run=" in script("trade_off")
    assert "is not in struct" in script("trade_off", "colour=1")


def test_peak_memory_is_what_an_action_takes_on_top_of_what_is_held(script):
    from bench_common import peak_memory

    held = torch.ones(20_000_000)  # 80 MB that must not count
    found = peak_memory(
        lambda: torch.ones(5_000_000).exp(), torch.device("cpu")
    )
    if found is None:
        pytest.skip("this system does not report a peak of memory")
    assert 20 < found < 70
    assert held.sum() == 20_000_000


@pytest.mark.slow
def test_effects_decides_without_training(script, tmp_path):
    words = ["train=false", "only=[distortion]", f"base=[{','.join(SCENE)}]"]
    assert not script("effects", *words)
    called, default = read(tmp_path, "effects")["rows"]
    assert called["auto"]
    assert not default["auto"]


def test_a_failed_training_is_reported_with_its_last_line(script, tmp_path):
    assert script("raster", "repeats=0")
    import bench_common

    with pytest.raises(GsganError, match=r"one\.log"):
        bench_common.train(["size=nosuch"], tmp_path / "runs" / "one")
    assert "nosuch" in (tmp_path / "runs" / "one.log").read_text()


def test_faults_are_found_in_a_capture(script, monkeypatch, capture, capsys):
    faults = __import__("faults")
    kept = [
        row
        for row in faults.FAULTS
        if row[0] == "`t` in mm" or row[0].startswith("K of")
    ][:3]
    monkeypatch.setattr(
        faults, "FAULTS", [*kept, ("nothing", lambda _: {}, "one")]
    )
    faults.main([capture])
    rows = [
        line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]
    ]
    assert [row[2].strip("| ") for row in rows] == [
        "error",
        "refused",
        "error",
        "**not found**",
    ]


def test_a_two_alternative_test_counts_what_was_chosen(
    tmp_path, run, monkeypatch, capsys
):
    def call(*words: str) -> None:
        monkeypatch.setattr(
            sys, "argv", ["two_alternatives", str(tmp_path), *words]
        )
        runpy.run_path(
            str(SCRIPTS / "two_alternatives.py"), run_name="__main__"
        )

    call(str(run), "--pairs", "2")
    assert (tmp_path / "page_01.png").is_file()
    rows = json.loads((tmp_path / "order.json").read_text())["rows"]
    answers = tmp_path / "answers.txt"
    first_wins = ["right" if place % 2 else "left" for place in rows]
    for sides, won in ((first_wins, len(rows) // 2), (["left"] * len(rows), 0)):
        answers.write_text(
            "\n".join(f"{i} {side}" for i, side in enumerate(sides, 1))
        )
        call("--answers", str(answers))
        assert f"{run}: {won} of {len(rows) // 2}" in capsys.readouterr().out
    answers.write_text("1 left\n")
    with pytest.raises(SystemExit, match="1 left"):
        call("--answers", str(answers))


@pytest.mark.slow
def test_a_film_has_no_error_against_itself(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    door = runpy.run_path(str(SCRIPTS / "front_door.py"))
    settings = {
        "avatar": "polo",
        "fps": 5,
        "cameras": 2,
        "size": 64,
        "clips": [["choreography", 0.5, 2], ["far", 1.0, 2]],
    }
    film = door["Film"](OmegaConf.create(settings))
    truth = tmp_path / "truth"
    source = tmp_path / "source"
    door["trace"](film, truth, tmp_path / "frames", 0, 1)
    door["write_truth"](film, truth)
    door["write_videos"](film, tmp_path / "frames", source)
    assert len(list(source.glob("*.mp4"))) == 2
    errors = door["landmark_errors"](truth, truth)
    assert not any(errors["exchanged"].values())
    assert errors["body"]["noise 90 %"] == 0
    assert door["camera_errors"](truth, truth) < 1e-6
    masks = door["mask_errors"](truth, truth)
    assert masks["IoU"] == 1
    assert masks["outline 90 %"] == 0


@pytest.mark.slow
def test_generator_compares_models_by_their_gaussians(script, tmp_path):
    given = ["experiment=smoke", "score_images=1", "lpips.path=null", *SCENE]
    assert not script(
        "generator",
        "points=[alg1]",
        "further={alg1: [wo_seg]}",
        f"train=[{','.join(given)}]",
    )
    rows = read(tmp_path, "generator")["rows"]
    trained = [(row["model"], row["image"]) for row in rows]
    assert trained == [
        ("full", "final"),
        ("full", "Step I's colour"),
        ("splat_only", "final"),
        ("wo_seg", "final"),
        ("wo_seg", "Step I's colour"),
    ]
    assert (tmp_path / "out" / "generator.png").is_file()
