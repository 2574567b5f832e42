"""ZJU-MoCap: what is read equals what was written, in each layout it is found in."""

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from capture_frames import (
    check_cameras,
    check_images,
    check_poses,
    check_skeletons,
)
from writers import zju as writers
from writers.common import make_subject, write_picture

from gsgan.body.smpl_names import CIHP
from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.zju import ZjuReader
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_mask
from gsgan.data.validation import Thresholds
from gsgan.scene import Frame

pytestmark = pytest.mark.usefixtures("model_once")


def read(root: Path, smpl: Path | None, **settings: Any) -> Layout:
    return ZjuReader(**settings)(
        root, Thresholds(), None if smpl is None else str(smpl)
    )


def frame_of(layout: Layout, camera: int, frame: int, **given: Any) -> Frame:
    return CaptureDataset(
        layout, [(layout.camera_names[camera], frame)], **given
    )[0]


@pytest.fixture(scope="module")
def written(tmp_path_factory, subject):
    """The original release; do not write into it."""
    return writers.write_original(
        tmp_path_factory.mktemp("zju") / "CoreView_377", subject
    )


def test_the_original_release_is_read_as_it_was_written(
    written, subject, smpl_file
):
    layout = read(written, smpl_file)
    assert layout.camera_names == ("Camera_B1", "Camera_B2", "Camera_B3")
    assert layout.frames == (0, 1, 2, 3)
    check_cameras(layout, subject.cameras)
    check_skeletons(layout, subject)
    check_poses(layout, subject)
    check_images(layout, subject)
    assert layout.notes == (
        "lengths of the cameras converted from mm to metres",
    )
    meta = layout.meta
    assert (meta.skeleton_source, meta.up_axis) == (
        "smpl24 -> mediapipe33",
        "-z",
    )
    assert (meta.body.kind, meta.body.file) == ("smpl", str(smpl_file))
    assert np.allclose(meta.body.betas, subject.shapes)
    assert meta.label_names == CIHP


def test_scores_have_the_labels_that_training_ignores(
    subject, smpl_file, tmp_path
):
    plain = replace(
        subject, cameras=[replace(c, dist=np.zeros(5)) for c in subject.cameras]
    )
    root = writers.write_original(tmp_path / "s", plain)
    layout = read(root, smpl_file, ignore_band=5)
    item = (layout.camera_names[0], layout.frames[0])
    trained = CaptureDataset(layout, [item], ignore_band=True)[0].labels
    scored = CaptureDataset(layout, [item])[0].labels
    assert int((trained == 255).sum()) > 0
    assert int((scored == 255).sum()) == 0
    kept = trained != 255
    assert torch.equal(trained[kept], scored[kept])


def test_the_outline_of_the_labels_is_ignored_as_wide_as_asked(
    subject, smpl_file, tmp_path
):
    plain = replace(
        subject, cameras=[replace(c, dist=np.zeros(5)) for c in subject.cameras]
    )
    root = writers.write_original(tmp_path / "s", plain)
    found = {}
    for band in (0, 3, 5):
        layout = read(root, smpl_file, ignore_band=band)
        labels = frame_of(layout, 0, 0, ignore_band=True).labels
        found[band] = int((labels == 255).sum())
        kept = labels[0].numpy() != 255
        assert np.array_equal(
            labels[0].numpy()[kept], subject.labels[0][0][kept]
        )
    assert found[0] == 0 < found[3] < found[5]


@pytest.mark.parametrize("masks", ["mask", "mask_cihp"])
def test_one_of_the_two_masks_is_enough(subject, smpl_file, tmp_path, masks):
    root = writers.write_original(tmp_path / "s", subject, masks=(masks,))
    layout = read(root, smpl_file)
    assert bool(layout.labels) == (masks == "mask_cihp")
    assert (layout.meta.label_names is None) == (masks == "mask")
    check_images(layout, subject)


def test_masks_are_joined_and_small_labels_are_not_thresholded(root, smpl_file):
    empty = np.zeros((40, 40), np.uint8)
    one = empty.copy()
    one[3, 4], other = 7, empty.copy()
    other[8, 9] = 1
    write_picture(root / "mask_cihp/Camera_B1/000002.png", one)
    write_picture(
        root / "mask/Camera_B1/000002.png", np.repeat(other[..., None], 3, -1)
    )
    layout = read(root, smpl_file)
    mask = read_mask(layout.mask_files("Camera_B1", 2), layout.pixels)
    assert (mask == 255).sum() == 2


def test_poses_of_69_are_padded(subject, smpl_file, tmp_path):
    root = writers.write_original(tmp_path / "s", subject, poses=69)
    check_poses(read(root, smpl_file), subject)


def test_the_refit_goes_before_the_first_fit_which_has_no_pose_blend_shapes(
    smpl_file, subject, tmp_path
):
    first = make_subject(smpl_file, pose_blend=False)
    assert np.abs(first.vertices - subject.vertices).max() > 1e-4
    root = writers.write_original(tmp_path / "s", first, params="params")
    check_skeletons(read(root, smpl_file), first)
    check_poses(read(root, smpl_file), first, blend=False)
    moved = replace(
        subject, Th=subject.Th + 0.01, vertices=subject.vertices + 0.01
    )
    moved = replace(moved, joints=subject.joints + 0.01)
    writers.write_original(root, moved)
    check_skeletons(read(root, smpl_file), moved)


NUMBERS = (1, 2, 19, 22)


@pytest.mark.parametrize("renamed", [False, True])
def test_subjects_313_and_315(smpl_file, tmp_path, renamed):
    odd = make_subject(smpl_file, cameras=4, first_frame=1, pose_blend=False)
    root = writers.write_313(tmp_path / "CoreView_313", odd, NUMBERS, renamed)
    layout = read(root, smpl_file)
    assert layout.camera_names == tuple(f"Camera ({n})" for n in NUMBERS)
    assert layout.frames == (1, 2, 3, 4)
    check_cameras(layout, odd.cameras)
    check_skeletons(layout, odd)
    check_images(layout, odd)


@pytest.mark.parametrize("listed", ["backslash", "slash", "none"])
def test_the_refined_release(subject, smpl_file, tmp_path, listed):
    root = writers.write_refined(tmp_path / "my_377", subject, listed)
    layout = read(root, smpl_file)
    assert layout.camera_names == ("00", "01", "02")
    check_cameras(layout, subject.cameras)
    check_skeletons(layout, subject)
    check_poses(layout, subject)
    check_images(layout, subject)
    assert not layout.labels


def test_the_index_is_small_and_goes_to_worker_processes(written, smpl_file):
    layout = read(written, smpl_file)
    held = pickle.dumps(layout)
    # per frame: 33 landmarks, 24 rotations, and three names a picture; no vertices, no pixels
    assert len(held) < 4 * 6000
    again = CaptureDataset(pickle.loads(held), [("Camera_B2", 3)])[0]
    assert torch.equal(again.image, frame_of(layout, 1, 3).image)


def test_a_camera_without_pictures_keeps_its_index(root, smpl_file):
    shutil.rmtree(root / "Camera_B2")
    layout = read(root, smpl_file)
    assert layout.camera_names == ("Camera_B1", "Camera_B2", "Camera_B3")
    assert not layout.images["Camera_B2"]


def test_labels_beyond_cihp_are_ignored(root, smpl_file):
    path = root / "mask_cihp/Camera_B1/000003.png"
    labels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    labels[labels == 5] = 109
    write_picture(path, labels)
    found = frame_of(read(root, smpl_file), 0, 3).labels
    assert set(found.unique().tolist()) <= {*range(20), 255}


# -- runs


def test_the_config_trains_with_segmentation_on_cihp_labels(
    compose, written, smpl_file
):
    from configs import build_avatar, build_data

    config = compose(
        "train",
        "size=tiny",
        "training=smoke",
        "data=zju_mocap",
        f"data.root={written}",
        f"data.smpl={smpl_file}",
        "data.size=32",
        "data.reader.drop_frames=3",
    )
    data = build_data(config)
    assert data.layout.frames == (0, 1, 2)
    info = data.info
    assert (info.body, info.n_labels) == ("smpl", 20)
    avatar = build_avatar(config, info, data.select_labelled("train")).eval()
    painting = avatar(*data.dataset("train")[0].inputs)
    assert "class vote over 9 images" in avatar.segmentation_why
    assert painting.segmentation.shape == (
        1,
        avatar.segmentation.classes,
        32,
        32,
    )
    assert set(avatar.segmentation.map.names) < set(CIHP)
    assert torch.isfinite(painting.image).all()


@pytest.mark.slow
def test_a_run_is_scored_with_its_model_file_elsewhere(
    written, smpl_file, tmp_path, inside
):
    first, now, run = (
        tmp_path / smpl_file.name,
        tmp_path / "moved" / smpl_file.name,
        tmp_path / "run",
    )
    shutil.copy(smpl_file, first)
    trained = inside(
        "train", "size=tiny", "training=smoke", "data=zju_mocap", f"data.root={written}",
        f"data.smpl={first}", "data.size=32", "data.reader.drop_frames=3", f"hydra.run.dir={run}",
    )  # fmt: skip
    assert trained.returncode == 0, trained.stderr
    before = (run / "metrics.json").read_text()
    now.parent.mkdir()
    first.rename(now)
    gone = inside("evaluate", f"run={run}")
    assert gone.returncode != 0
    assert f"{first} does not exist, the body model file of" in " ".join(
        gone.stderr.split()
    )
    assert "data_smpl=<where it is now>" in " ".join(gone.stderr.split())
    (run / "metrics.json").unlink()
    found = inside("evaluate", f"run={run}", f"data_smpl={now}")
    assert found.returncode == 0, found.stderr
    assert json.loads((run / "metrics.json").read_text()) == json.loads(before)
