"""EasyMocap's folders: what is read equals what was written, and damage ends in one sentence."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from writers.common import Subject, write_picture
from writers.easymocap import (
    NAMES,
    body_25,
    hand_joints,
    write_calibration,
    write_easymocap,
    write_people,
)

from gsgan.data.checks import Checks
from gsgan.data.dataset import CaptureDataset
from gsgan.data.files import read_colour
from gsgan.data.formats.easymocap import EasymocapReader
from gsgan.data.formats.smpl_motion import Motion, posed
from gsgan.data.formats.trust import Trust
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_mask
from gsgan.skeleton.smpl import to_mediapipe33
from gsgan.utils.errors import ConfigError, DataError

pytestmark = pytest.mark.usefixtures("model_once")

NO_LOOK = Trust(frames=0, watched_masks=0)
# MediaPipe's landmark to OpenPose's BODY_25, by hand: nose, eyes, ears, limbs, feet.
LANDMARKS = {
    0: 0, 2: 16, 5: 15, 7: 18, 8: 17, 11: 5, 12: 2, 13: 6, 14: 3, 15: 7, 16: 4, 23: 12, 24: 9,
    25: 13, 26: 10, 27: 14, 28: 11, 29: 21, 30: 24, 31: 19, 32: 22,
}  # fmt: skip


def read(root: Path, smpl: Path | None = None, **settings: Any) -> Layout:
    return EasymocapReader(**settings)(root, Checks(), None if smpl is None else str(smpl))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, subject: Subject) -> Path:
    """Keypoints and fits; do not write into it."""
    return write_easymocap(tmp_path_factory.mktemp("easymocap") / "take", subject)


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    """The same to damage."""
    return Path(shutil.copytree(written, tmp_path / "take"))


def edit_people(
    root: Path, change: Callable[[list[Any]], object], kind: str = "keypoints3d", frame: int = 1
) -> Path:
    path = root / kind / f"{frame:06d}.json"
    people = json.loads(path.read_text())
    change(people)
    write_people(path, people)
    return path


def refused(root: Path, *parts: str, smpl: Path | None = None, **settings: Any) -> None:
    with pytest.raises(DataError) as caught:
        read(root, smpl, **settings)
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value), caught.value


# --- read equals written ------------------------------------------------------------------------


def check_cameras(layout: Layout, subject: Subject) -> None:
    assert layout.camera_names == NAMES  # "1", "2", "10": in natural order
    for entry, camera in zip(layout.cameras.values(), subject.cameras, strict=True):
        assert np.allclose(entry.K - camera.K, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], atol=1e-6)
        assert np.allclose(entry.R, camera.R, atol=1e-6)
        assert np.allclose(entry.t, camera.t, atol=1e-6)
        assert np.allclose(entry.dist[:5], camera.dist, atol=1e-6)
        assert entry.size == camera.size[::-1]


def test_cameras_are_paired_by_name(written: Path, subject: Subject) -> None:
    """extri.yml lists them the other way round, and a "none" stands in both."""
    layout = read(written)
    check_cameras(layout, subject)
    assert layout.frames == (0, 1, 2, 3)
    assert layout.notes == ()


@pytest.mark.parametrize("options", [{"sizes": False}, {"lens": "D"}, {"both": False}])
def test_other_ways_to_write_the_calibration(
    root: Path, subject: Subject, options: dict[str, Any]
) -> None:
    write_calibration(root, subject, **options)
    check_cameras(read(root), subject)


def test_keypoints_are_the_landmarks_that_body_25_knows(written: Path, subject: Subject) -> None:
    layout = read(written)
    for i, frame in enumerate(subject.frames):
        joints = body_25(subject, i)
        conf = layout.landmarks.visibility[frame]
        expected = np.zeros(33)
        for landmark, joint in LANDMARKS.items():
            expected[landmark] = joints[joint, 3]
            if joints[joint, 3] > 0:
                assert np.allclose(layout.landmarks.p[frame][landmark], joints[joint, :3])
        assert np.allclose(conf, expected)
        unknown = layout.landmarks.p[frame][conf == 0]
        assert np.linalg.norm(unknown, axis=-1).min() > 0.5  # stand-ins are never zero
    meta = layout.meta
    assert (meta.skeleton_source, meta.body) == ("body25 -> mediapipe33", None)
    assert layout.poses is None


def test_hands_give_the_fingers(tmp_path: Path, subject: Subject) -> None:
    root = write_easymocap(tmp_path / "take", subject, hands=True, output="output/")
    landmarks = read(root).landmarks
    hands = hand_joints(subject, 2)[:, :3].reshape(2, 21, 3)
    for side in (0, 1):  # knuckles of the little finger, index, and thumb
        for landmark, joint in ((17, 17), (19, 5), (21, 2)):
            assert np.allclose(landmarks.p[2][landmark + side], hands[side, joint])
            assert landmarks.visibility[2][landmark + side] == 0.8


def test_fits_give_skeletons_and_poses(written: Path, subject: Subject, smpl_file: Path) -> None:
    layout = read(written, smpl_file)  # auto: fits, since the model is there
    assert layout.poses is not None
    for i, frame in enumerate(subject.frames):
        p, conf = to_mediapipe33(subject.joints[i], subject.vertices[i])
        assert np.allclose(layout.landmarks.p[frame][conf > 0], p[conf > 0], atol=1e-5)
    theta, transl = (
        np.stack([held[f] for f in subject.frames])
        for held in (layout.poses.theta, layout.poses.transl)
    )
    betas = np.repeat(subject.shapes[None], len(theta), 0)
    motion = Motion(np.array(subject.frames), theta, transl, betas)
    assert np.allclose(posed(subject.model, motion)[0], subject.vertices, atol=1e-6)
    assert layout.meta.skeleton_source == "smpl24 -> mediapipe33"
    assert layout.meta.body is not None
    assert (layout.meta.body.kind, layout.meta.body.file) == ("smpl", str(smpl_file))


def test_which_skeleton_is_taken(root: Path, smpl_file: Path) -> None:
    def source(smpl: Path | None = None, **settings: Any) -> str:
        return read(root, smpl, **settings).meta.skeleton_source

    assert source() == "body25 -> mediapipe33"
    assert source(smpl_file, skeleton="keypoints3d") == "body25 -> mediapipe33"
    refused(root, "smpl holds SMPL parameters but no joints", "data.smpl=", skeleton="smpl")
    shutil.rmtree(root / "keypoints3d")
    refused(root, "smpl holds SMPL parameters but no joints")
    assert source(smpl_file) == "smpl24 -> mediapipe33"
    shutil.rmtree(root / "smpl")
    refused(root, "has no skeletons; expected keypoints3d/ or smpl/")
    refused(root, "expected smpl/ in it", skeleton="smpl")


def test_pictures_and_masks_are_those_that_were_written(written: Path, subject: Subject) -> None:
    layout = read(written)
    for i, frame in enumerate(subject.frames):
        for c, name in enumerate(NAMES):
            mask = read_mask(layout.mask_files(name, frame), layout.pixels)
            assert np.array_equal(mask, np.where(subject.labels[i][c] > 0, 255, 0))
            image = read_colour(layout.image_path(name, frame)).astype(int)
            assert np.abs(image - subject.images[i][c]).mean() < 12


def test_pictures_are_undistorted(written: Path, subject: Subject) -> None:
    """The body's vertices, projected without a lens, land on the mask seen through one."""
    frame = CaptureDataset(read(written), [("10", 1)])[0]
    points = torch.from_numpy(subject.vertices[1]).float()[None]
    u, v = frame.camera.project(points)[0][0].floor().long().T
    assert frame.mask[0, 0][v.clamp(0, 39), u.clamp(0, 39)].mean() > 0.9


# --- masks --------------------------------------------------------------------------------------


def test_a_persons_own_mask_goes_before_nobodys(tmp_path: Path, subject: Subject) -> None:
    root = write_easymocap(tmp_path / "take", subject, person=3, pid=True)
    write_picture(root / "mask/1/000000.png", np.full((40, 40), 255, np.uint8))
    write_picture(root / "mask/1/000000_0.png", np.full((40, 40), 255, np.uint8))
    layout = read(root, person=3)
    assert layout.mask_path("1", 0).name == "000000_3.png"
    assert layout.mask_path("2", 2).name == "000002_3.png"
    write_picture(root / "mask/1/first.png", np.zeros((40, 40), np.uint8))
    refused(root, "mask/1/first.png has no frame number", person=3)


def test_mask_rules(root: Path) -> None:
    write_picture(root / "mask/1/000000.png", np.full((40, 40), 100, np.uint8))
    for rule, expected in (("nonzero", 255), ("threshold", 0), ("grey", 100), ("label", 255)):
        layout = read(root, mask_rule=rule, trust=NO_LOOK)
        assert (read_mask(layout.mask_files("1", 0), layout.pixels) == expected).all()
    with pytest.raises(ConfigError, match="mask_rule must be one of grey"):
        EasymocapReader(mask_rule="soft")
    with pytest.raises(ConfigError, match="skeleton must be one of auto, smpl, keypoints3d"):
        EasymocapReader(skeleton="body25")


def test_masks_that_are_missing(root: Path) -> None:
    (root / "mask").rename(root / "mask-schp")
    refused(root, str(root / "mask"), "every image needs a mask", "data.reader.masks")
    assert read(root, masks="mask-schp").frames == (0, 1, 2, 3)


# --- bad input, one row of the list of them each ------------------------------------------------


def test_rotations_that_disagree(root: Path) -> None:
    path = root / "extri.yml"
    text = re.sub(r"(Rot_2:.*?data: \[ *)[^,]+", r"\g<1>0.125", path.read_text(), flags=re.S)
    path.write_text(text)
    refused(root, "extri.yml, camera 2: Rot_2 and R_2 are different rotations")


def test_a_camera_in_one_file_only(root: Path) -> None:
    path = root / "extri.yml"
    whole = path.read_text()
    path.write_text(whole.replace("T_10:", "T_11:"))
    refused(root, "extri.yml lacks", "T_10")
    path.unlink()
    refused(root, "extri.yml does not exist; a folder of EasyMocap holds")


def test_pictures_without_calibration_and_the_other_way_round(root: Path) -> None:
    shutil.copytree(root / "images/1", root / "images/4")
    refused(root, "images/4 is not a camera of", "intri.yml", "which lists 1, 2, 10")
    shutil.rmtree(root / "images/4")
    shutil.rmtree(root / "images/2")
    layout = read(root)
    assert layout.camera_names == ("1", "10")
    assert "lists cameras without images, left out: 2" in layout.notes[0]
    shutil.rmtree(root / "images")
    (root / "videos").mkdir()
    refused(root, "images holds no folder of a camera", "extract the frames of videos/")


def test_an_empty_camera(root: Path) -> None:
    for path in (root / "images/2").iterdir():
        path.unlink()
    refused(root, str(root / "images/2"), "holds no images")


def test_another_size_than_calibrated(root: Path) -> None:
    path = root / "intri.yml"
    path.write_text(re.sub(r"W_2: 40", "W_2: 80", path.read_text()))
    refused(root, "images/2/000000.jpg is 40x40", "intri.yml", "80x40")


def test_a_lens_that_is_not_said_is_none_and_noted(root: Path) -> None:
    path = root / "intri.yml"
    path.write_text(path.read_text().replace("dist_2:", "other_2:"))
    layout = read(root)
    assert not layout.cameras["2"].distorted
    assert layout.cameras["1"].distorted
    assert "no lens distortion for 2" in layout.notes[0]


def test_a_person_who_is_missing(root: Path) -> None:
    edit_people(root, lambda people: people[0].update(id=5))
    layout = read(root)
    assert layout.frames == (0, 2, 3)
    assert "lacks person 0 at frames 1" in layout.notes[0]
    refused(root, "has no person 7 in the 4 of its 4 files", "(found: 0, 5)", person=7)


def test_more_people_than_one(root: Path, subject: Subject) -> None:
    elsewhere = body_25(subject, 0)
    elsewhere[:, 0] += 5
    other = {"id": 1, "keypoints3d": elsewhere.tolist()}
    edit_people(root, lambda people: people.insert(0, other))
    layout = read(root)
    assert np.allclose(layout.landmarks.p[1][11], body_25(subject, 1)[5, :3])
    assert "more people than person 0 at frames 1" in layout.notes[0]


def test_joints_without_confidence_are_unknown(root: Path) -> None:
    """EasyMocap writes zeros with confidence 0, or below, where it saw nothing."""

    def change(people: list[Any]) -> None:
        people[0]["keypoints3d"][7] = [0, 0, 0, 0]
        people[0]["keypoints3d"][4] = [0, 0, 0, -1]
        people[0]["keypoints3d"][6] = [float("nan"), 0, 0, 1]

    edit_people(root, change)
    landmarks = read(root).landmarks
    assert landmarks.visibility[1][[13, 15, 16]].tolist() == [0, 0, 0]
    assert np.allclose(landmarks.p[1][15], landmarks.p[0][15])  # stands in as in the frame before


def test_joints_of_three_columns_have_confidence_one(root: Path) -> None:
    edit_people(root, lambda people: people[0].update(
        keypoints3d=[joint[:3] for joint in people[0]["keypoints3d"]]
    ))  # fmt: skip
    assert set(read(root).landmarks.visibility[1]) == {0, 1}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p[0].update(keypoints3d=[[0, 0, 0, 1]] * 17), "'keypoints3d' must have shape"),
        (lambda p: p[0].update(keypoints3d="none"), "'keypoints3d' must have shape"),
        (lambda p: p[0].pop("keypoints3d"), "'keypoints3d' must have shape"),
        (lambda p: p[0].update(id="first"), "needs a whole 'id' that no other has, found first"),
        (lambda p: p.append(p[0]), "needs a whole 'id' that no other has, found 0"),
        (lambda p: p.append(3), "must hold a list of people"),
    ],
)
def test_keypoints_that_cannot_be(
    root: Path, change: Callable[[list[Any]], object], message: str
) -> None:
    path = edit_people(root, change)
    refused(root, str(path), message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p[0].update(poses=[[0.0] * 87]), "'poses' must hold 72 or 69 numbers"),
        (lambda p: p[0].pop("Rh"), "has no 'Rh'"),
        (lambda p: p[0].update(Th=[[0, 0, float("inf")]]), "'Th' must hold finite numbers"),
        (lambda p: p[0].update(shapes=[0.0] * 9), "'shapes' must hold 10 numbers"),
    ],
)
def test_fits_that_cannot_be(
    root: Path, smpl_file: Path, change: Callable[[list[Any]], object], message: str
) -> None:
    path = edit_people(root, change, "smpl")
    refused(root, f"{path}, person 0", message, smpl=smpl_file)


@pytest.mark.parametrize("text", ["", "{", '{"a": 1}', "3", "[" * 5000, "1" * 5000])
def test_files_that_are_no_list_of_people(root: Path, text: str) -> None:
    path = root / "keypoints3d/000002.json"
    path.write_text(text)
    refused(root, str(path))


def test_a_frame_without_keypoints_is_dropped(root: Path) -> None:
    (root / "keypoints3d/000002.json").unlink()
    layout = read(root)
    assert layout.frames == (0, 1, 3)
    assert "without a row in keypoints3d/: 2" in layout.notes[0]


def test_millimetres_are_found_out(root: Path) -> None:
    def change(people: list[Any]) -> None:
        people[0]["keypoints3d"] = [
            [*(1000 * x for x in joint[:3]), joint[3]] for joint in people[0]["keypoints3d"]
        ]

    for frame in range(4):
        edit_people(root, change, frame=frame)
    with pytest.raises(DataError) as caught:
        read(root)
    assert "\n" not in str(caught.value)
    assert "keypoints3d" in str(caught.value)


def test_another_persons_masks_do_not_meet_the_skeleton(root: Path) -> None:
    corner = np.zeros((40, 40), np.uint8)
    corner[:8, :8] = 255
    for path in (root / "mask").rglob("*.png"):
        write_picture(path, corner)
    refused(root, "do not meet", "one person (data.reader.person)")


def test_the_config_reads_it_in_worker_processes(written: Path, smpl_file: Path, compose) -> None:
    from hydra.utils import instantiate

    config = compose(
        "train", "data=easymocap", f"data.root={written}", f"data.smpl={smpl_file}",
        "data.size=16", "data.workers=1", "data.test_cameras=[10]", "data.test_frames=3",
    )  # fmt: skip
    data = instantiate(config.data)
    assert next(iter(data.train_dataloader())).image.shape == (1, 3, 16, 16)
    assert data.info.skeleton_source == "smpl24 -> mediapipe33"
    assert data.splits.test_cameras == ("10",)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"K": np.diag([-50.0, 50.0, 1.0])}, "camera 2: the focal lengths in K must be above 0"),
        ({"dist": np.zeros(3)}, "camera 2: dist must hold 4, 5 or 8"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "camera 2: R mirrors"),
        ({"R": np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])}, "camera 2: R is not a rotation"),
        ({"t": np.array([0.0, 0.0, -3.0])}, "of the joints lie behind it|joints inside the pic"),
    ],
)
def test_bad_cameras_are_refused(
    subject: Subject, tmp_path: Path, values: dict[str, np.ndarray], message: str
) -> None:
    root = write_easymocap(tmp_path / "e", subject)
    cameras = list(subject.cameras)
    cameras[1] = replace(cameras[1], **values)
    write_rig(root, replace(subject, cameras=tuple(cameras)))
    with pytest.raises(DataError, match=message) as caught:
        EasymocapReader()(root, Checks())
    assert "\n" not in str(caught.value)


def write_rig(root: Path, subject: Subject) -> None:
    """The calibration anew, with Rot alone: R as a vector can be nothing but a rotation."""
    write_calibration(root, subject)
    text = (root / "extri.yml").read_text()
    parts = text.split("\nR_")
    whole = [part.partition("\nRot_")[2] for part in parts[1:]]
    (root / "extri.yml").write_text("\nRot_".join([parts[0], *whole]))


def test_sizes_come_from_images_if_absent(subject: Subject, tmp_path: Path) -> None:
    root = write_easymocap(tmp_path / "e", subject)
    write_calibration(root, subject, sizes=False)
    sizes = {camera.size for camera in EasymocapReader()(root, Checks()).cameras.values()}
    assert sizes == {(40, 40)}
