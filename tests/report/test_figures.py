"""``gsgan.report run=…`` as a user types it: every figure, and every error."""

import json
import shutil
from pathlib import Path

import cv2
import pytest
import torch
from commands import refused
from configs import build_data, load_avatar
from omegaconf import OmegaConf

from gsgan.metrics.image import edge_f1, psnr
from gsgan.report.figures.run import FIGURES
from gsgan.run.stored import load_config

FEW = ("shots.strip=2",)

pytestmark = (
    pytest.mark.slow
)  # make test runs `report run=` as the README has it


@pytest.fixture
def twin(run, tmp_path):
    """Another run on the same data."""
    return Path(shutil.copytree(run, tmp_path / "twin"))


def edit(run: Path, **values) -> None:
    path = run / ".hydra" / "config.yaml"
    config = OmegaConf.load(path)
    for key, value in values.items():
        OmegaConf.update(config, key.replace("__", "."), value)
    OmegaConf.save(config, path)


def test_every_figure_is_made_with_numbers_of_the_images_shown(
    run, twin, tmp_path, inside
):
    out = tmp_path / "out"
    whole = "margin=9"  # metres: the window is the image
    result = inside(
        "report", f"run={run}", f"compare=[{twin}]", f"out={out}", whole, *FEW
    )
    assert result.returncode == 0, result.stdout + result.stderr
    record = json.loads((out / "figures.json").read_text())["figures"]
    assert list(record) == list(FIGURES)
    for name in FIGURES:
        image = cv2.imread(str(out / f"{name}.png"))
        assert image is not None
        assert image.std() > 5  # not blank
        pdf = (out / f"{name}.pdf").read_bytes()
        assert pdf.startswith(b"%PDF")
        assert pdf.rstrip().endswith(b"%%EOF")
    captions = (out / "captions.md").read_text()
    assert "Marked: perceptual loss" in captions
    assert "split novel_pose" in captions.lower()
    assert not list(out.glob(".*"))
    found = record["comparison"]["numbers"]
    assert found == expected(run, found)
    twins = list(found["cam00/000004"])
    assert twins == ["gsgan (1)", "gsgan (2)"]


def expected(run: Path, found: dict) -> dict:
    """PSNR and edge F1 of whole images, rendered here without the figures' code."""
    config = load_config(run)
    data = build_data(config)
    avatar, _ = load_avatar(run, config, data)
    dataset = data.dataset("novel_pose")
    numbers: dict = {}
    for name, panels in found.items():
        camera, frame_id = name.split("/")
        frame = dataset[dataset.items.index((camera, int(frame_id)))]
        with torch.no_grad():
            image = avatar(*frame.inputs).image.clamp(0, 1)
        score = {
            "psnr": pytest.approx(float(psnr(image, frame.image)), abs=1e-4),
            "edge_f1": pytest.approx(
                float(edge_f1(image, frame.image)), abs=1e-9
            ),
        }
        numbers[name] = dict.fromkeys(panels, score)
    return numbers


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"data__size": 24}, ("differ in data", "image size")),
        ({"data__train_frames": "0-2"}, ("differ in data", "frames, split")),
    ],
)
def test_runs_on_other_data_are_refused(
    run, twin, tmp_path, inside, change, words
):
    edit(twin, **change)
    result = inside(
        "report",
        f"run={run}",
        f"compare=[{twin}]",
        f"out={tmp_path / 'out'}",
        *FEW,
    )
    refused(result, str(run), str(twin), *words)
    assert not list((tmp_path / "out").glob("*.p*"))


def test_an_unfinished_run_is_marked_in_captions(twin, tmp_path, inside):
    path = twin / "checkpoints" / "last.ckpt"
    checkpoint = torch.load(path, weights_only=True)
    total = checkpoint["gsgan"]["step"]
    checkpoint["gsgan"]["step"] = 3
    torch.save(checkpoint, path)
    given = (f"run={twin}", f"out={tmp_path / 'out'}", "figures=strip", *FEW)
    result = inside("report", *given)
    message = f"is unfinished: 3 of {total} iterations"
    assert message in result.stdout
    assert message in (tmp_path / "out" / "captions.md").read_text()


def test_a_collapsed_run_is_not_drawn(twin, tmp_path, inside):
    path = twin / "checkpoints" / "last.ckpt"
    checkpoint = torch.load(path, weights_only=True)
    for key, value in checkpoint["state_dict"].items():
        if "generator" in key and value.is_floating_point():
            value.fill_(float("nan"))
    torch.save(checkpoint, path)
    result = inside(
        "report",
        f"run={twin}",
        f"out={tmp_path / 'out'}",
        "figures=strip",
        *FEW,
    )
    refused(result, str(twin), "not finite")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("run=null",), ("runs and run are not set",)),
        (("run=/nowhere",), ("/nowhere", "not a run folder")),
        (("compare=[{run}]",), ("a run is given twice",)),
        (("compare=[/nowhere]",), ("/nowhere", "not a run folder")),
        (
            ("figures=[strip,stripe]",),
            ("figures must be one of comparison", "stripe"),
        ),
        (("figures=[ablation,strip]",), ("figures=ablation compares runs",)),
        (("frames=[a]",), ("frames must be a whole number",)),
        (("shots.strip=0", "figures=strip"), ("shots.strip", "at least 1")),
        (("margin=-1",), ("margin",)),
        (("out={run}/metrics.json",), ("metrics.json", "cannot be written to")),
        (("data_root=/nowhere",), ("/nowhere",)),
    ],
)
def test_a_wrong_value_ends_in_one_message(run, inside, given, words):
    given = [argument.replace("{run}", str(run)) for argument in given]
    if not any(argument.startswith("run=") for argument in given):
        given.append(f"run={run}")
    result = inside("report", *given)
    refused(result, *words)
    assert len(result.stderr.strip().splitlines()) == 1
