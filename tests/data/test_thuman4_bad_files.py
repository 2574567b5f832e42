"""THuman4.0: every damage is told in one sentence."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import thuman4_folders
from make import edit_json
from thuman4_folders import edit_params, read, refused
from writers.common import write_picture
from writers.smplx_rig import SmplxSubject
from writers.thuman4 import write_thuman4

from gsgan.data.dataset import CaptureDataset
from gsgan.data.files import read_colour
from gsgan.data.formats.smplx_rig import read_missing
from gsgan.data.splits import make_splits
from gsgan.utils.errors import ConfigError, DataError

pytestmark = pytest.mark.usefixtures("model_once")
written = thuman4_folders.written
root = thuman4_folders.root

LISTED = ("images\\cam01\\00000002.jpg", "./cam02/00000003.jpg", "", "cam00/00000099.jpg")


def edit_camera(root: Path, name: str, **values: Any) -> None:
    edit_json(root / "calibration.json", lambda content: content[name].update(values))


def test_listed_files_are_left_out_of_every_split(
    tmp_path: Path, smplx_subject: SmplxSubject, smplx_file: Path
) -> None:
    root = write_thuman4(tmp_path / "s", smplx_subject, LISTED)
    layout = read(root, smplx_file)
    assert read_missing(root / "missing_img_files.txt", layout.cameras) == {
        ("cam01", 2),
        ("cam02", 3),
        ("cam00", 99),
    }
    splits = make_splits(layout, test_cameras=["cam02"], test_frames=[3])
    for items in splits.items.values():
        assert ("cam01", 2) not in items
        assert ("cam02", 3) not in items
    assert len(splits.items["train"]) == 2 * 3 - 1
    assert 3 not in layout.images["cam02"]
    assert "3 images named in" in layout.notes[0]
    assert "2 of them with a file" in layout.notes[0]


def test_a_list_that_is_none(root: Path, smplx_file: Path) -> None:
    path = root / "missing_img_files.txt"
    path.write_text("cam00/00000001.jpg\nnothing here\n")
    refused(root, smplx_file, str(path), "line 2", "cam00/00000012.jpg", "nothing here")
    path.write_text("".join(f"cam01/{i:08d}.jpg\n" for i in range(4)))
    refused(root, smplx_file, str(path), "leaves no image of camera cam01")
    path.write_bytes(b"\xff\xfe\x00")
    refused(root, smplx_file, str(path), "cannot be read as text")
    path.unlink()
    assert "every image in the folders is used" in read(root, smplx_file).notes[0]


def test_a_picture_that_is_gone_shifts_nothing(
    root: Path, smplx_subject: SmplxSubject, smplx_file: Path
) -> None:
    (root / "images/cam00/00000001.jpg").unlink()
    layout = read(root, smplx_file)
    assert list(layout.images["cam00"]) == [0, 2, 3]
    image = read_colour(layout.image_path("cam00", 2)).astype(int)
    assert np.abs(image - smplx_subject.images[2][0]).mean() < 12


def test_a_damaged_picture_is_named(root: Path, smplx_file: Path) -> None:
    path = root / "images/cam01/00000002.jpg"
    path.write_bytes(path.read_bytes()[:-100])
    layout = read(root, smplx_file)
    with pytest.raises(DataError, match=r"cam01/00000002\.jpg is damaged or cut off"):
        CaptureDataset(layout, [("cam01", 2)])[0]


def test_a_mask_of_another_size(root: Path, smplx_file: Path) -> None:
    write_picture(root / "masks/cam02/00000000.jpg", np.zeros((22, 26), np.uint8))
    refused(root, smplx_file, "masks/cam02/00000000.jpg is 26x22", "52x44")


def test_masks_that_are_missing(root: Path, smplx_file: Path) -> None:
    (root / "masks/cam01/00000002.jpg").unlink()
    assert any("1 of 12 images have no mask" in n for n in read(
        root, smplx_file, max_missing_masks=0.1
    ).notes)  # fmt: skip
    refused(root, smplx_file, "masks/cam01/00000002", "8% of all 12 images have no mask")
    shutil.rmtree(root / "masks/cam01")
    refused(root, smplx_file, str(root / "masks/cam01"), "holds no masks")


def test_parameters_of_smpl(root: Path, smplx_file: Path) -> None:
    edit_params(root, lambda arrays: arrays.update(body_pose=np.zeros((4, 69))))
    refused(root, smplx_file, "smpl_params.npz", "(4, 63)", "69 are those of SMPL")


def test_cameras_and_folders_are_the_same_ones(root: Path, smplx_file: Path) -> None:
    shutil.copytree(root / "images/cam00", root / "images/cam03")
    refused(root, smplx_file, "lists 3 cameras, but 4 have a folder", "cam03 is not calibrated")
    shutil.rmtree(root / "images/cam03")
    shutil.rmtree(root / "images/cam01")
    refused(root, smplx_file, "lists 3 cameras, but 2 have a folder", "cam01 lacks one")


def test_a_transposed_size(root: Path, smplx_file: Path) -> None:
    edit_camera(root, "cam01", imgSize=[44, 52])
    refused(root, smplx_file, "images/cam01/00000000.jpg is 52x44", "44x52")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"K": [1, 2]}, "'K' must hold finite numbers of shape (9,)"),
        ({"K": [-1, 0, 0, 0, 1, 0, 0, 0, 1]}, "focal lengths in K must be above 0"),
        ({"R": [1, 0.5, 0, 0, 1, 0, 0, 0, 1]}, "R is not a rotation"),
        ({"R": [1, 0, 0, 0, 1, 0, 0, 0, -1]}, "R mirrors"),
        ({"T": [0, float("nan"), 1]}, "'t' must hold finite numbers"),
        ({"distCoeff": [1, 2, 3]}, "dist must hold 4, 5 or 8"),
        ({"imgSize": "big"}, "'imgSize' must hold finite numbers"),
    ],
)
def test_cameras_that_cannot_be(
    root: Path, smplx_file: Path, values: dict[str, Any], message: str
) -> None:
    edit_camera(root, "cam01", **values)
    refused(root, smplx_file, "calibration.json, camera cam01", message)


def test_a_camera_without_all_its_keys(root: Path, smplx_file: Path) -> None:
    edit_json(root / "calibration.json", lambda content: content["cam02"].pop("R"))
    refused(root, smplx_file, "camera cam02: expected K, R, T and imgSize, found K, T, imgSize")


def test_millimetres_and_camera_to_world_are_found_out(root: Path, smplx_file: Path) -> None:
    content = json.loads((root / "calibration.json").read_text())
    edit_json(root / "calibration.json", lambda c: [
        entry.update(T=[1000 * x for x in entry["T"]]) for entry in c.values()
    ])  # fmt: skip
    refused(root, smplx_file, "m from the person (median), expected 0.5-20 m", "calibration.json")
    for entry in content.values():
        R, T = np.reshape(entry["R"], (3, 3)), np.array(entry["T"])
        entry.update(R=R.T.ravel().tolist(), T=(-R.T @ T).tolist())
    (root / "calibration.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"world to camera|from the person"):
        read(root, smplx_file)


def test_a_lens_is_not_applied_but_noted(
    tmp_path: Path, smplx_subject: SmplxSubject, smplx_file: Path
) -> None:
    root = write_thuman4(tmp_path / "s", smplx_subject, distCoeff=[0.1, 0, 0, 0, 0])
    layout = read(root, smplx_file)
    assert not any(camera.distorted for camera in layout.cameras.values())
    assert any("gives 3 cameras lens distortion" in note for note in layout.notes)
    assert read(root, smplx_file, undistort=True).cameras["cam00"].dist[0] == 0.1


def test_another_subjects_parameters_do_not_meet_the_masks(root: Path, smplx_file: Path) -> None:
    edit_params(root, lambda arrays: arrays.update(transl=arrays["transl"] + [0.0, 0.0, -0.7]))
    refused(root, smplx_file, "the projected body and the masks do not meet", "one subject")


# --- parameters ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("transl"), "has no array transl"),
        (lambda a: a.update(left_hand_pose=np.zeros((4, 12))), "look like PCA coefficients"),
        (
            lambda a: a.update(jaw_pose=np.zeros((3, 3))),
            "'jaw_pose' must hold numbers",
        ),
        (
            lambda a: a.update(transl=np.zeros(12)),
            "must hold numbers of shape (frames, 3)",
        ),
        (lambda a: a.update(transl=np.array([["a"] * 3] * 4)), "'transl' must hold numbers"),
        (lambda a: a.update(betas=np.ones((1, 30))), "has 30 coefficients, the model file 10"),
        (lambda a: a.update(betas=np.full((1, 10), np.nan)), "'betas' must hold finite numbers"),
        (lambda a: a["transl"].fill(np.inf), "no finite one of a frame that has images"),
    ],
)
def test_parameters_that_cannot_be(
    root: Path, smplx_file: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    edit_params(root, change)
    refused(root, smplx_file, "smpl_params.npz", message)


def test_frames_without_finite_parameters_are_dropped_and_named(
    root: Path, smplx_file: Path
) -> None:
    def change(arrays: dict[str, Any]) -> None:
        arrays["body_pose"][1, 7] = np.nan

    edit_params(root, change)
    layout = read(root, smplx_file)
    assert layout.frames == (0, 2, 3)
    assert any("NaN or infinity at frames 1" in note for note in layout.notes)


def test_fewer_rows_than_pictures(root: Path, smplx_file: Path) -> None:
    def change(arrays: dict[str, Any]) -> None:
        for key in arrays.keys() - {"betas"}:
            arrays[key] = arrays[key][:3]

    edit_params(root, change)
    layout = read(root, smplx_file)
    assert layout.frames == (0, 1, 2)
    assert any("without a row in smpl_params.npz: 3" in note for note in layout.notes)


def test_pickled_parameters_pass_the_gate_or_are_refused(root: Path, smplx_file: Path) -> None:
    """The release's readers allow pickles; here they build numbers only, and nothing runs."""
    import os

    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.system, ("touch /nowhere/at/all",)

    whole = (root / "smpl_params.npz").read_bytes()
    edit_params(root, lambda a: a.update(transl=a["transl"].astype(object)))
    assert read(root, smplx_file).frames == (0, 1, 2, 3)
    (root / "smpl_params.npz").write_bytes(whole)
    evil = {"betas": np.array(Evil(), dtype=object)}
    edit_params(root, lambda a: a.update(evil))
    refused(root, smplx_file, "smpl_params.npz asks for", "system", "nothing was run")


# --- what else is needed ------------------------------------------------------------------------


def test_joints_need_the_users_model(root: Path, smplx_file: Path, smpl_file: Path) -> None:
    refused(root, None, str(root), "SMPL-X parameters but no joints", "data.smpl=/path/to/your")
    refused(root, smpl_file, str(smpl_file), "24 joints", "SMPL-X (55 joints)")
    with pytest.raises(ConfigError, match="does not exist"):
        read(root, root / "SMPLX.npz")


@pytest.mark.parametrize("name", ["calibration.json", "smpl_params.npz"])
def test_a_file_that_is_missing(root: Path, smplx_file: Path, name: str) -> None:
    (root / name).unlink()
    refused(root, smplx_file, str(root / name), "a folder of THuman4.0 holds")
