"""The scripts of docs/examples/ run, on tiny data; the commands they start run in this process."""

import importlib
import json
import os
import re
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from commands import ROOT
from PIL import Image
from scipy.spatial.transform import Rotation

import gsgan
from gsgan.export.splats import splats_of
from gsgan.run.shared import DEMO_FOLDER, DEMO_MOTION
from gsgan.utils.provenance import verify

FOLDER = ROOT / "docs" / "examples"
TINY = ["size=tiny", "data.size=32", "data.body=none"]
FEW = [
    "segmentation=1",
    "step_one=1",
    "step_two=2",
    "discriminator_start=1",
    "epoch=4",
]
EACH_STEP = ["training.log_every=1", "+trainer.log_every_n_steps=1"]
SHORT = [*TINY, *(f"training.schedule.{phase}" for phase in FEW)]


@pytest.fixture
def script(inside, monkeypatch):
    """Imports an example by its name."""

    def run(
        command: list[str], check: bool, env: dict[str, str] | None = None
    ) -> None:
        assert check
        result = inside(command[2].removeprefix("gsgan."), *command[3:])
        assert result.returncode == 0, result.stdout + result.stderr

    def example(name: str) -> ModuleType:
        module = importlib.import_module(name)
        monkeypatch.setattr(
            module, "subprocess", SimpleNamespace(run=run), raising=False
        )
        return module

    monkeypatch.syspath_prepend(str(FOLDER))
    # of a sweep's jobs
    monkeypatch.setenv("PYTHONPATH", str(FOLDER), prepend=os.pathsep)
    return example


def test_your_own_cameras_then_live(script, tmp_path, capfd):
    own, live = script("own_cameras"), script("drive_live")
    own.main(tmp_path, ["training=smoke", *SHORT])
    with Image.open(tmp_path / "new_view.png") as image:
        assert image.size == (own.SIZE, own.SIZE)
        assert "trainedAlgorithmicMedia" in str(image.info)
        assert np.asarray(image).min() < 250  # somebody is there, before white

    landmarks = tmp_path / "capture" / "landmarks3d.npz"
    live.main(tmp_path / "run", landmarks, tmp_path / "live", 64)
    assert f"{own.FRAMES} images" in capfd.readouterr().out
    frames = [
        np.asarray(Image.open(path))
        for path in sorted((tmp_path / "live").glob("*.png"))
    ]
    assert len(frames) == own.FRAMES
    assert (frames[0] != frames[3]).any()


@pytest.mark.slow
def test_a_loss_and_an_ablation_of_your_own(script, capture, tmp_path):
    own = script("own_loss")
    own.main(["data=capture", f"data.root={capture}", *EACH_STEP, *SHORT])
    logs = list((tmp_path / "runs" / "own_loss").glob("*/logs/metrics.csv"))
    assert len(logs) == 2
    assert all("smooth" in path.read_text().partition("\n")[0] for path in logs)
    table = (tmp_path / "runs" / "own_loss_table" / "report.md").read_text()
    assert "wo_normals" in table


def test_gaussians_are_fitted_to_an_image(script, tmp_path):
    image = str(DEMO_FOLDER / "preview.png")
    psnr = script("fit_image").main(image, str(tmp_path / "a.png"), 60)
    assert psnr > 22  # 30.4 after 300 iterations, 9.7 before the first
    with Image.open(tmp_path / "a.png") as found:
        assert found.size == (128, 128)


def test_gaussians_follow_a_pose(script, tmp_path):
    script("densify_and_pose").main(str(tmp_path / "a.png"))
    with Image.open(tmp_path / "a.png") as file:
        pixels = np.asarray(file).astype(int)
    still, moved = pixels[:, :256], pixels[:, 256:]
    changed = np.abs(moved - still).max(axis=-1) > 20
    # One arm has moved: the legs, and the other arm, have not.
    assert changed[:, :128].mean() > 0.01
    assert not changed[130:].any()
    assert not changed[:, 150:].any()


def test_the_avatar_is_driven_into_a_video(script, tmp_path):
    av = pytest.importorskip("av")
    out = tmp_path / "a.mp4"
    script("drive_avatar").main(out, frames=3)
    assert verify(out).synthetic
    with av.open(out) as container:
        frames = [x.to_ndarray(format="rgb24") for x in container.decode()]
    assert len(frames) == 3
    assert frames[0].min() < 60  # somebody is there, on white


def test_skinned_splats_follow_the_motion(script, tmp_path):
    """By the formula of linear blend skinning they come to where gsgan's Gaussians are."""
    script("skinned_splats").main(tmp_path, frames=2)
    skin = json.loads((tmp_path / "skin.json").read_text())
    vertices = trimesh.load(tmp_path / "rest.ply", process=False).vertices
    bones, weights = np.array(skin["bones"]), np.array(skin["weights"])
    assert bones.shape == weights.shape == (len(vertices), 4)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)

    # The second frame, by its bones' moves since the T-pose.
    turns = Rotation.from_quat(skin["quaternions"][1]).as_matrix()
    moved = np.einsum("jab,nb->nja", turns, vertices) + skin["translations"][1]
    rows = np.arange(len(vertices))[:, None]
    found = (weights[..., None] * moved[rows, bones]).sum(1)

    # The avatar's Gaussians in that pose, with the offsets that Ψ gives them.
    avatar = gsgan.load("demo")
    with np.load(DEMO_MOTION) as file:
        skeleton = torch.from_numpy(file["p"][1:2])
    seen = torch.ones(skeleton.shape[:2])
    with torch.no_grad():
        body = avatar.body_pose(skeleton, seen)
        expected = splats_of(avatar, skeleton, seen > 0, body).means
    apart = np.linalg.norm(found - expected, axis=1)
    assert np.median(apart) < 0.003
    assert np.linalg.norm(vertices - expected, axis=1).mean() > 0.1


def test_the_notebook_runs(inside, tmp_path, monkeypatch):
    """Its cells, one after another, in this process."""
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("IPython")
    pytest.importorskip("av")
    monkeypatch.setenv("GSGAN_NOTEBOOK_PIXELS", "64")
    monkeypatch.setenv("GSGAN_NOTEBOOK_FRAMES", "2")
    monkeypatch.chdir(tmp_path)

    process = subprocess.run

    def run(command: list[str], **options):
        if command[0] != sys.executable:
            return process(command, **options)
        result = inside(command[2].removeprefix("gsgan."), *command[3:])
        assert result.returncode == 0, result.stdout + result.stderr
        return result

    monkeypatch.setattr(subprocess, "run", run)
    book = nbformat.read(FOLDER / "first_look.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in book.cells)
    names = {}
    for cell in book.cells:
        if cell.cell_type == "code":
            exec(cell.source, names)
    assert names["image"].shape == (1, 3, 64, 64)
    assert (tmp_path / "dance.mp4").is_file()


def test_the_page_lists_the_scripts():
    page = (FOLDER / "README.md").read_text()
    for path in FOLDER.glob("*.py"):
        assert re.search(
            rf"^python docs/examples/{path.name}", page, flags=re.M
        ), path.name
