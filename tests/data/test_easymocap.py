"""EasyMocap's folders: what is read equals what was written."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_frames import (
    check_cameras,
    check_images,
    check_poses,
    check_skeletons,
)
from make import edit_json
from writers.common import write_picture
from writers.easymocap import (
    NAMES,
    body_25,
    hand_joints,
    write_calibration,
    write_easymocap,
)

from gsgan.data.formats.easymocap import EasymocapReader
from gsgan.data.layout import Layout
from gsgan.data.validation import Thresholds
from gsgan.utils.errors import DataError
from gsgan.utils.frame_files import natural_order

pytestmark = pytest.mark.usefixtures("model_once")

# MediaPipe's landmark to OpenPose's BODY_25, by hand: nose, eyes, ears, limbs, feet.
LANDMARKS = {
    0: 0, 2: 16, 5: 15, 7: 18, 8: 17, 11: 5, 12: 2, 13: 6, 14: 3, 15: 7, 16: 4, 23: 12, 24: 9,
    25: 13, 26: 10, 27: 14, 28: 11, 29: 21, 30: 24, 31: 19, 32: 22,
}  # fmt: skip


def read(root: Path, smpl: Path | None = None, **settings: Any) -> Layout:
    return EasymocapReader(**settings)(
        root, Thresholds(), None if smpl is None else str(smpl)
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory, subject):
    """Keypoints and fits; do not write into it."""
    return write_easymocap(
        tmp_path_factory.mktemp("easymocap") / "take", subject
    )


def edit_people(
    root: Path, change: Callable[[list[Any]], object], frame: int = 1
) -> None:
    edit_json(root / f"keypoints3d/{frame:06d}.json", change)


def refused(
    root: Path, *parts: str, smpl: Path | None = None, **settings: Any
) -> None:
    with pytest.raises(DataError) as caught:
        read(root, smpl, **settings)
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value), caught.value


@pytest.mark.parametrize(
    "names",
    [
        ["Camera_B2", "Camera_B10"],
        ["2", "10", "a"],
        [
            "rate -2",
            "rate -0.5",
            "rate 1e-3",
            "rate 0.05",
            "rate 0.5",
            "rate 10",
        ],
        ["1400000000000000001", "1400000000000000002"],
        ["cam", "cam 1", "cam_1"],
    ],
)
def test_natural_order(names):
    others = names[::-1]
    assert sorted(others, key=natural_order) == names


def test_cameras_are_paired_by_name_and_have_their_images(written, subject):
    """extri.yml lists them the other way round, and a "none" stands in both."""
    layout = read(written)
    check_images(layout, subject)
    assert layout.camera_names == NAMES  # "1", "2", "10": in natural order
    check_cameras(layout, subject.cameras)
    assert layout.frames == (0, 1, 2, 3)
    assert layout.notes == ()


@pytest.mark.parametrize(
    "options", [{"sizes": False}, {"lens": "D"}, {"both": False}]
)
def test_other_ways_to_write_the_calibration(root, subject, options):
    write_calibration(root, subject, **options)
    check_cameras(read(root), subject.cameras)


def test_keypoints_are_the_landmarks_that_body_25_knows(written, subject):
    layout = read(written)
    for i, frame in enumerate(subject.frames):
        joints = body_25(subject, i)
        conf = layout.landmarks.visibility[frame]
        expected = np.zeros(33)
        for landmark, joint in LANDMARKS.items():
            expected[landmark] = joints[joint, 3]
            if joints[joint, 3] > 0:
                assert np.allclose(
                    layout.landmarks.p[frame][landmark], joints[joint, :3]
                )
        assert np.allclose(conf, expected)
        unknown = layout.landmarks.p[frame][conf == 0]
        assert (
            np.linalg.norm(unknown, axis=-1).min() > 0.5
        )  # stand-ins are never zero
    meta = layout.meta
    assert (meta.skeleton_source, meta.body) == ("body25 -> mediapipe33", None)
    assert layout.poses is None


def test_hands_give_the_fingers(tmp_path, subject):
    root = write_easymocap(
        tmp_path / "take", subject, hands=True, output="output/"
    )
    landmarks = read(root).landmarks
    hands = hand_joints(subject, 2)[:, :3].reshape(2, 21, 3)
    for side in (0, 1):  # knuckles of the little finger, index, and thumb
        for landmark, joint in ((17, 17), (19, 5), (21, 2)):
            assert np.allclose(
                landmarks.p[2][landmark + side], hands[side, joint]
            )
            assert landmarks.visibility[2][landmark + side] == 0.8


def test_fits_give_skeletons_and_poses(written, subject, smpl_file):
    layout = read(written, smpl_file)  # auto: fits, since the model is there
    check_skeletons(layout, subject)
    check_poses(layout, subject)
    assert layout.meta.skeleton_source == "smpl24 -> mediapipe33"
    assert (layout.meta.body.kind, layout.meta.body.file) == (
        "smpl",
        str(smpl_file),
    )


def test_which_skeleton_is_taken(root, smpl_file):
    def source(smpl: Path | None = None) -> str:
        return read(root, smpl).meta.skeleton_source

    assert source() == "body25 -> mediapipe33"
    shutil.rmtree(root / "keypoints3d")
    refused(root, "smpl holds SMPL parameters but no joints")
    assert source(smpl_file) == "smpl24 -> mediapipe33"
    shutil.rmtree(root / "smpl")
    refused(root, "has no skeletons; expected keypoints3d/ or smpl/")


def test_omissions_are_noted(root, subject):
    shutil.rmtree(root / "images/2")
    edit_people(root, lambda people: people[0].update(id=5), frame=1)
    (root / "keypoints3d/000002.json").unlink()
    intri = root / "intri.yml"
    intri.write_text(intri.read_text().replace("dist_10:", "other_10:"))
    elsewhere = body_25(subject, 0)
    elsewhere[:, 0] += 5
    other = {"id": 1, "keypoints3d": elsewhere.tolist()}
    edit_people(root, lambda people: people.insert(0, other), frame=3)
    layout = read(root)
    assert (layout.camera_names, layout.frames) == (("1", "10"), (0, 3))
    assert np.allclose(layout.landmarks.p[3][11], body_25(subject, 3)[5, :3])
    assert not layout.cameras["10"].distorted
    for note in (
        "no lens distortion for 10",
        "lists cameras without images, left out: 2",
        "lacks person 0 at frames 1",
        "without a row in keypoints3d/: 1-2",
    ):
        assert any(note in held for held in layout.notes), note
    refused(
        root,
        "has no person 7 in the 3 of its 3 files",
        "(found: 0, 1, 5)",
        person=7,
    )


def test_joints_without_confidence_are_unknown(root):
    """EasyMocap writes zeros with confidence 0, or below, where it saw nothing."""

    def change(people: list[Any]) -> None:
        people[0]["keypoints3d"][7] = [0, 0, 0, 0]
        people[0]["keypoints3d"][4] = [0, 0, 0, -1]
        people[0]["keypoints3d"][6] = [float("nan"), 0, 0, 1]

    def without_confidence(people: list[Any]) -> None:
        people[0]["keypoints3d"] = [
            joint[:3] for joint in people[0]["keypoints3d"]
        ]

    edit_people(root, change)
    edit_people(root, without_confidence, frame=2)
    landmarks = read(root).landmarks
    assert landmarks.visibility[1][[13, 15, 16]].tolist() == [0, 0, 0]
    assert np.allclose(
        landmarks.p[1][15], landmarks.p[0][15]
    )  # as in the frame before
    assert set(landmarks.visibility[2]) == {0, 1}


# --- masks --------------------------------------------------------------------------------------


def test_a_persons_own_mask_goes_before_nobodys(tmp_path, subject):
    root = write_easymocap(tmp_path / "take", subject, person=3, pid=True)
    write_picture(root / "mask/1/000000.png", np.full((40, 40), 255, np.uint8))
    write_picture(
        root / "mask/1/000000_0.png", np.full((40, 40), 255, np.uint8)
    )
    layout = read(root, person=3)
    assert layout.mask_path("1", 0).name == "000000_3.png"
    assert layout.mask_path("2", 2).name == "000002_3.png"
    write_picture(root / "mask/1/first.png", np.zeros((40, 40), np.uint8))
    refused(root, "mask/1: first.png has no frame number", person=3)
