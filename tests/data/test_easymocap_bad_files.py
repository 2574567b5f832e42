"""EasyMocap's folders: damage ends in one sentence."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import easymocap_folders
import numpy as np
import pytest
from easymocap_folders import edit_people, read, refused
from writers.common import Subject, write_picture
from writers.easymocap import body_25, write_calibration, write_easymocap

from gsgan.data.formats.easymocap import EasymocapReader
from gsgan.data.validation import Thresholds
from gsgan.utils.errors import DataError

pytestmark = pytest.mark.usefixtures("model_once")
written = easymocap_folders.written
root = easymocap_folders.root


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
        EasymocapReader()(root, Thresholds())
    assert "\n" not in str(caught.value)


def write_rig(root: Path, subject: Subject) -> None:
    """The calibration anew, with Rot alone: R as a vector can be nothing but a rotation."""
    write_calibration(root, subject)
    text = (root / "extri.yml").read_text()
    parts = text.split("\nR_")
    whole = [part.partition("\nRot_")[2] for part in parts[1:]]
    (root / "extri.yml").write_text("\nRot_".join([parts[0], *whole]))
