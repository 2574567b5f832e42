"""``gsgan.load`` and ``Avatar.render``: five lines of Python from a run folder to an image."""

import shutil
import subprocess
import sys

import pytest
import torch
from configs import build_data, load_avatar

import gsgan
from gsgan.metrics.regions import on_background
from gsgan.run.stored import CONFIG, load_config
from gsgan.scene import cat
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.errors import DataError


@pytest.fixture(scope="module")
def scored(run):
    """What evaluation paints of a training frame: (frame, painting)."""
    config = load_config(run)
    data = build_data(config)
    frame = data.dataset("train")[0]
    with torch.no_grad():
        return frame, load_avatar(run, config, data)[0](*frame.inputs)


def test_a_loaded_avatar_renders_what_evaluation_paints(run, scored, tmp_path):
    """Bit for bit, without the dataset."""
    frame, painting = scored
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    text = (copy / CONFIG).read_text()
    (copy / CONFIG).write_text(
        text.replace("root: /", "root: /no/longer/there/")
    )
    avatar = gsgan.load(str(copy), device="cpu")
    assert not avatar.training
    image = avatar.render(frame.skeleton[0], frame.camera, body=frame.body)
    assert torch.equal(image, painting.image.clamp(0, 1))
    on_white = avatar.render(
        frame.skeleton, frame.camera, body=frame.body, background=1.0
    )
    expected = on_background(
        painting.image.clamp(0, 1), painting.alpha.clamp(0, 1), 1.0
    )
    assert torch.equal(on_white, expected.clamp(0, 1))
    with pytest.raises(ValueError, match=r" 3 cameras.* 2"):
        avatar.render(
            frame.skeleton.repeat(3, 1, 1),
            cat([frame.camera] * 2),
            body=frame.body,
        )


def test_one_camera_serves_many_poses_and_lost_joints_are_replaced(run, scored):
    frame, _ = scored
    avatar = gsgan.load(run, device="cpu")
    skeletons = frame.skeleton.repeat(2, 1, 1)
    skeletons[1, 15] = float("nan")
    body = cat([frame.body, frame.body])
    images = avatar.render(
        skeletons, frame.camera, body=body, background=(1.0, 0.0, 0.0)
    )
    assert images.shape == (2, *frame.image.shape[1:])
    assert torch.isfinite(images).all()


def test_a_bare_skeleton_is_enough(run, scored):
    frame, _ = scored
    avatar = gsgan.load(run, device="cpu")
    body = avatar.body_pose(frame.skeleton, frame.visibility)
    image = avatar.render(frame.skeleton, frame.camera)
    assert torch.equal(
        image, avatar.render(frame.skeleton, frame.camera, body=body)
    )
    swapped = frame.skeleton[:, list(MEDIAPIPE33.mirror)]
    assert torch.isfinite(
        avatar.render(swapped, frame.camera)
    ).all()  # a single frame is not judged


def test_a_folder_without_a_run_or_a_checkpoint_is_one_sentence(run, tmp_path):
    with pytest.raises(DataError, match="not a run folder"):
        gsgan.load(tmp_path)
    (tmp_path / ".hydra").mkdir()
    shutil.copy(run / CONFIG, tmp_path / CONFIG)
    with pytest.raises(DataError, match="no checkpoint"):
        gsgan.load(tmp_path)


LIGHT = {
    "gsgan": "torch",
    "gsgan.scene": "lightning kornia torchmetrics cv2 hydra",
    "gsgan.model.avatar": "gsgan.data gsgan.motion gsgan.run hydra omegaconf",
    "gsgan.model.harmonic": "gsgan.data gsgan.motion gsgan.run hydra omegaconf",
}


def test_importing_is_light():
    """One process imports all, each after what it may load itself."""
    code = "import sys\n"
    for module, heavy in LIGHT.items():
        code += f"import {module}\n"
        code += f"print([m for m in {heavy.split()} if m in sys.modules])\n"
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert out.stdout.split() == ["[]"] * len(LIGHT)


def test_a_name_that_gsgan_does_not_have():
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        _ = gsgan.lode
