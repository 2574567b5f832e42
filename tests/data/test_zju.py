"""ZJU-MoCap: what is read equals what was written, in each layout it is found in."""

from __future__ import annotations

import json
import pickle
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from writers import zju as writers
from writers.common import Subject, make_subject, write_object, write_picture
from writers.smpl import write_smpl

from gsgan.body.smpl_names import CIHP
from gsgan.data.checks import Checks
from gsgan.data.dataset import CaptureDataset
from gsgan.data.files import frame_files, natural_order
from gsgan.data.formats.smpl_motion import Motion, landmarks_of, posed
from gsgan.data.formats.trust import Trust, box_iou, mask_box
from gsgan.data.formats.zju import ZjuReader, camera_folders, frame_number, read_annots
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_labels, read_mask
from gsgan.scene import Frame
from gsgan.skeleton.smpl import to_mediapipe33
from gsgan.utils.errors import ConfigError, DataError

pytestmark = pytest.mark.usefixtures("model_once")


def read(root: Path, smpl: Path | None, **settings: Any) -> Layout:
    return ZjuReader(**settings)(root, Checks(), None if smpl is None else str(smpl))


def frame_of(layout: Layout, camera: int, frame: int) -> Frame:
    return CaptureDataset(layout, [(layout.camera_names[camera], frame)])[0]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, subject: Subject) -> Path:
    """The original release; do not write into it."""
    return writers.write_original(tmp_path_factory.mktemp("zju") / "CoreView_377", subject)


@pytest.fixture
def original(written: Path, tmp_path: Path) -> Path:
    """The same to damage."""
    return Path(shutil.copytree(written, tmp_path / "CoreView_377"))


def check_cameras(layout: Layout, subject: Subject) -> None:
    for entry, camera in zip(layout.cameras.values(), subject.cameras, strict=True):
        K = camera.K + np.array(
            [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        )  # our pixel centres are at +0.5
        assert np.allclose(entry.K, K, atol=1e-6)
        assert np.allclose(entry.R, camera.R, atol=1e-6)
        assert np.allclose(entry.t, camera.t, atol=1e-6)
        assert np.allclose(entry.dist[:5], camera.dist, atol=1e-6)
        assert entry.size == camera.size[::-1]


def check_skeletons(layout: Layout, subject: Subject, vertices: bool = True) -> None:
    for i, frame in enumerate(subject.frames):
        p, conf = to_mediapipe33(subject.joints[i], subject.vertices[i] if vertices else None)
        seen = conf > 0
        assert np.allclose(layout.landmarks.p[frame][seen], p[seen], atol=1e-5)
        assert np.array_equal(layout.landmarks.visibility[frame], conf)
        assert np.isfinite(layout.landmarks.p[frame]).all()


def check_poses(layout: Layout, subject: Subject, blend: bool = True) -> None:
    """theta and transl, in the model's own convention, give the vertices that were written."""
    assert layout.poses is not None
    theta, transl = (
        np.stack([held[f] for f in subject.frames])
        for held in (layout.poses.theta, layout.poses.transl)
    )
    betas = np.repeat(subject.shapes[None], len(theta), 0)
    motion = Motion(np.array(subject.frames), theta, transl, betas)
    assert np.allclose(posed(subject.model, motion, blend)[0], subject.vertices, atol=1e-6)


def check_pictures(layout: Layout, subject: Subject) -> None:
    for i, frame in enumerate(subject.frames):
        for c, name in enumerate(layout.camera_names):
            labels = subject.labels[i][c]
            mask = read_mask(layout.mask_files(name, frame), layout.pixels)
            assert np.array_equal(mask, np.where(labels > 0, 255, 0))
            stored = cv2.imread(str(layout.image_path(name, frame)))[..., ::-1].astype(int)
            assert np.abs(stored - subject.images[i][c]).mean() < 12  # chroma of a small JPEG
            if layout.labels:
                path = layout.label_path(name, frame)
                assert path is not None
                assert np.array_equal(read_labels(path, layout.pixels, CIHP), labels)


def test_the_original_release_is_read_as_it_was_written(
    written: Path, subject: Subject, smpl_file: Path
) -> None:
    layout = read(written, smpl_file)
    assert layout.camera_names == ("Camera_B1", "Camera_B2", "Camera_B3")
    assert layout.frames == (0, 1, 2, 3)
    check_cameras(layout, subject)
    check_skeletons(layout, subject)
    check_poses(layout, subject)
    check_pictures(layout, subject)
    assert layout.notes == ("lengths of the cameras converted from mm to metres",)
    meta = layout.meta
    assert (meta.skeleton_source, meta.up_axis) == ("smpl24 -> mediapipe33", "-z")
    assert meta.body is not None
    assert (meta.body.kind, meta.body.file) == ("smpl", str(smpl_file))
    assert np.allclose(meta.body.betas, subject.shapes)
    assert meta.label_names == CIHP


def test_the_mouth_that_smpl_does_not_know_is_masked_and_not_zero(
    written: Path, smpl_file: Path
) -> None:
    frame = frame_of(read(written, smpl_file), 0, 0)
    assert frame.visibility[0, 9:11].tolist() == [0, 0]
    assert (frame.skeleton[0, 9:11].norm(dim=-1) > 0.1).all()
    assert (frame.visibility[0, [11, 12, 23, 24]] == 1).all()


def test_undistorted_pictures_meet_the_pinhole_camera(
    written: Path, subject: Subject, smpl_file: Path
) -> None:
    """The body's vertices, projected without a lens, land on the mask that was seen through one."""
    layout = read(written, smpl_file)
    for c in range(3):
        frame = frame_of(layout, c, 1)
        assert frame.camera.dist is None
        vertices = torch.from_numpy(subject.vertices[1]).float()[None]
        pixels, _ = frame.camera.project(vertices)
        u, v = pixels[0].floor().long().clamp(0, 39).unbind(-1)
        near = torch.nn.functional.max_pool2d(frame.mask, 3, 1, 1)[0, 0]
        assert near[v, u].mean() > 0.99
        assert set(frame.mask.unique().tolist()) <= {0.0, 1.0}  # nearest: no value is invented
        assert frame.labels is not None
        assert set(frame.labels.unique().tolist()) <= {*range(20), 255}


def test_the_outline_of_the_labels_is_ignored_as_wide_as_asked(
    subject: Subject, smpl_file: Path, tmp_path: Path
) -> None:
    plain = replace(subject, cameras=[replace(c, dist=np.zeros(5)) for c in subject.cameras])
    root = writers.write_original(tmp_path / "s", plain)
    found = {}
    for band in (0, 3, 5):
        labels = frame_of(read(root, smpl_file, ignore_band=band), 0, 0).labels
        assert labels is not None
        found[band] = int((labels == 255).sum())
        kept = labels[0].numpy() != 255
        assert np.array_equal(labels[0].numpy()[kept], subject.labels[0][0][kept])
    assert found[0] == 0 < found[3] < found[5]


@pytest.mark.parametrize("masks", ["mask", "mask_cihp"])
def test_one_of_the_two_masks_is_enough(
    subject: Subject, smpl_file: Path, tmp_path: Path, masks: str
) -> None:
    root = writers.write_original(tmp_path / "s", subject, masks=(masks,))
    layout = read(root, smpl_file)
    assert bool(layout.labels) == (masks == "mask_cihp")
    assert (layout.meta.label_names is None) == (masks == "mask")
    check_pictures(layout, subject)


def test_masks_are_joined_and_small_labels_are_not_thresholded(
    original: Path, smpl_file: Path
) -> None:
    empty = np.zeros((40, 40), np.uint8)
    one = empty.copy()
    one[3, 4], other = 7, empty.copy()
    other[8, 9] = 1
    write_picture(original / "mask_cihp/Camera_B1/000002.png", one)
    write_picture(original / "mask/Camera_B1/000002.png", np.repeat(other[..., None], 3, -1))
    for masks, count in (("both", 2), ("mask", 1), ("mask_cihp", 1)):
        layout = read(original, smpl_file, masks=masks)
        mask = read_mask(layout.mask_files("Camera_B1", 2), layout.pixels)
        assert (mask == 255).sum() == count


def test_poses_of_69_are_padded(subject: Subject, smpl_file: Path, tmp_path: Path) -> None:
    root = writers.write_original(tmp_path / "s", subject, poses=69)
    check_poses(read(root, smpl_file), subject)


def test_the_refit_goes_before_the_first_fit_which_has_no_pose_blend_shapes(
    smpl_file: Path, subject: Subject, tmp_path: Path
) -> None:
    first = make_subject(smpl_file, pose_blend=False)
    assert np.abs(first.vertices - subject.vertices).max() > 1e-4
    root = writers.write_original(tmp_path / "s", first, params="params")
    check_skeletons(read(root, smpl_file), first)
    check_poses(read(root, smpl_file), first, blend=False)
    moved = replace(subject, Th=subject.Th + 0.01, vertices=subject.vertices + 0.01)
    moved = replace(moved, joints=subject.joints + 0.01)
    writers.write_original(root, moved)
    check_skeletons(read(root, smpl_file), moved)
    check_skeletons(read(root, smpl_file, fit="first"), first)


NUMBERS = (1, 2, 19, 22)


@pytest.mark.parametrize("renamed", [False, True])
def test_subjects_313_and_315(smpl_file: Path, tmp_path: Path, renamed: bool) -> None:
    odd = make_subject(smpl_file, cameras=4, first_frame=1, pose_blend=False)
    root = writers.write_313(tmp_path / "CoreView_313", odd, NUMBERS, renamed)
    layout = read(root, smpl_file)
    assert layout.camera_names == tuple(f"Camera ({n})" for n in NUMBERS)
    assert layout.frames == (1, 2, 3, 4)
    check_cameras(layout, odd)
    check_skeletons(layout, odd)
    check_pictures(layout, odd)


def test_frame_numbers_of_long_names() -> None:
    name = "CoreView_313_Camera_(1)_0042_2019-08-23_16-08-50.592"
    assert frame_number(name) == 42
    assert frame_number("0042") == 42
    assert frame_number("000042") == 42
    assert frame_number("frame") is None


def test_21_cameras_keep_their_own_numbers(tmp_path: Path) -> None:
    numbers = [*range(1, 20), 22, 23]
    for n in numbers:
        (tmp_path / f"Camera ({n})").mkdir()
    cams = {key: [np.eye(3).tolist()] * 21 for key in "KRTD"}
    ims = [{"ims": [f"Camera ({n})/0001.jpg" for n in numbers]}]
    for listed in (ims, []):  # with and without the list of pictures
        write_object(tmp_path / "annots.npy", {"cams": cams, "ims": listed})
        names = list(camera_folders(tmp_path, read_annots(tmp_path), []))
        assert (names[19], names[20]) == ("Camera (22)", "Camera (23)")
    assert sorted(["Camera_B10", "Camera_B2"], key=natural_order) == ["Camera_B2", "Camera_B10"]


@pytest.mark.parametrize("listed", ["backslash", "slash", "none"])
def test_the_refined_release(
    subject: Subject, smpl_file: Path, tmp_path: Path, listed: str
) -> None:
    root = writers.write_refined(tmp_path / "my_377", subject, listed)
    layout = read(root, smpl_file)
    assert layout.camera_names == ("00", "01", "02")
    check_cameras(layout, subject)
    check_skeletons(layout, subject)
    check_poses(layout, subject)
    check_pictures(layout, subject)
    assert not layout.labels
    assert any("rebuilt" in note for note in layout.notes) == (listed == "none")


def test_landmarks_from_few_vertices_are_those_of_all(subject: Subject) -> None:
    betas = np.repeat(subject.shapes[None], 4, 0)
    theta = subject.poses.reshape(4, 24, 3).copy()
    theta[:, 0] = subject.Rh
    motion = Motion(np.arange(4), theta, subject.Th, betas)
    for blend in (True, False):
        vertices, joints = posed(subject.model, motion, blend)
        expected, conf = to_mediapipe33(joints, vertices)
        p, found = landmarks_of(subject.model, motion, blend)
        assert np.array_equal(conf, found)
        assert np.allclose(p[conf > 0], expected[conf > 0], atol=1e-12)


def test_the_index_is_small_and_goes_to_worker_processes(written: Path, smpl_file: Path) -> None:
    layout = read(written, smpl_file)
    held = pickle.dumps(layout)
    # per frame: 33 landmarks, 24 rotations, and three names a picture; no vertices, no pixels
    assert len(held) < 4 * 6000
    again = CaptureDataset(pickle.loads(held), [("Camera_B2", 3)])[0]
    assert torch.equal(again.image, frame_of(layout, 1, 3).image)


def test_frames_pair_by_number(original: Path, subject: Subject, smpl_file: Path) -> None:
    """A picture that is gone from one camera shifts nothing."""
    for folder in ("Camera_B2", "mask/Camera_B2", "mask_cihp/Camera_B2"):
        for file in (original / folder).glob("000001.*"):
            file.unlink()
    layout = read(original, smpl_file)
    assert sorted(layout.images["Camera_B2"]) == [0, 2, 3]
    assert frame_of(layout, 1, 2).frame_id.item() == 2
    check_skeletons(layout, subject)
    assert any("Camera_B2 3" in note for note in layout.notes)


def test_frames_without_parameters_are_dropped_and_named(original: Path, smpl_file: Path) -> None:
    (original / "new_params/2.npy").unlink()
    layout = read(original, smpl_file)
    assert layout.frames == (0, 1, 3)
    assert "1 of 4 frames dropped, without a row in new_params/: 2" in layout.notes


def test_a_camera_without_pictures_keeps_its_index(original: Path, smpl_file: Path) -> None:
    shutil.rmtree(original / "Camera_B2")
    layout = read(original, smpl_file)
    assert layout.camera_names == ("Camera_B1", "Camera_B2", "Camera_B3")
    assert not layout.images["Camera_B2"]
    assert any("1 of 3 cameras have no images here: Camera_B2" in n for n in layout.notes)


def test_some_missing_masks_are_left_out_and_counted(original: Path, smpl_file: Path) -> None:
    for kind in ("mask", "mask_cihp"):
        (original / kind / "Camera_B3/000001.png").unlink()
    layout = read(original, smpl_file)
    assert 1 not in layout.images["Camera_B3"]
    assert any("1 of 12 images have no mask and are left out" in n for n in layout.notes)
    with pytest.raises(DataError, match=r"000001.png does not exist.*8% of all 12 images"):
        read(original, smpl_file, max_missing_masks=0.05)


def test_a_mask_of_odd_area_is_noted_and_can_be_left_out(original: Path, smpl_file: Path) -> None:
    write_picture(original / "mask/Camera_B1/000002.png", np.full((40, 40), 255, np.uint8))
    layout = read(original, smpl_file, trust=Trust(frames=0))
    assert any("more than 50% off the usual at frames 2 of 4" in note for note in layout.notes)
    without = read(original, smpl_file, trust=Trust(frames=0), drop_frames="2")
    assert without.frames == (0, 1, 3)
    assert not any("off the usual" in note for note in without.notes)


def test_labels_beyond_cihp_are_ignored(original: Path, smpl_file: Path) -> None:
    path = original / "mask_cihp/Camera_B1/000003.png"
    labels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    labels[labels == 5] = 109
    write_picture(path, labels)
    found = frame_of(read(original, smpl_file), 0, 3).labels
    assert found is not None
    assert set(found.unique().tolist()) <= {*range(20), 255}


def test_shapes_that_change_are_noted(original: Path, subject: Subject, smpl_file: Path) -> None:
    changed = replace(subject, shapes=subject.shapes + 0.01)
    writers._params(original, "new_params", replace(changed, frames=[0]))
    assert any("shape changes between frames" in n for n in read(original, smpl_file).notes)


# --- damage: each case is one row of what is seen in practice --------------------------------


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    content = np.load(path, allow_pickle=True).item()
    write_object(path, change(content) or content)


def annots(change: Callable[[Any], Any]) -> Callable[[Path], None]:
    return lambda root: edit(root / "annots.npy", change)


def cams(key: str, value: Callable[[Any], Any], index: int | None = 1) -> Callable[[Path], None]:
    def change(content: Any) -> None:
        entries = content["cams"][key]
        chosen = range(len(entries)) if index is None else [index]
        for i in chosen:
            entries[i] = value(np.array(entries[i]))

    return annots(change)


def params(**values: Any) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        edit(root / "new_params/2.npy", lambda content: content.update(values))

    return damage


def every_param(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        for path in (root / "new_params").iterdir():
            edit(path, change)

    return damage


def picture(name: str, array: np.ndarray) -> Callable[[Path], None]:
    return lambda root: write_picture(root / name, array)


def remove(*names: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        for name in names:
            path = root / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def cut(name: str, keep: float) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        data = (root / name).read_bytes()
        (root / name).write_bytes(data[: int(len(data) * keep)])

    return damage


def moved_body(root: Path) -> None:
    """Parameters of another take."""
    every_param(lambda c: c.update(Th=c["Th"] + [[0.6, 0.8, 0.0]]))(root)


class Evil:
    def __reduce__(self) -> Any:
        import os

        return os.system, ("touch /tmp/never",)


def evil(root: Path) -> None:
    array = np.array({"cams": Evil()}, dtype=object)
    np.save(root / "annots.npy", array, allow_pickle=True)


def shear(R: np.ndarray) -> np.ndarray:
    return R @ np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])


def folder_without_list(root: Path) -> None:
    annots(lambda content: content.update(ims=[]))(root)
    (root / "Camera_B4").mkdir()


def swapped_lists(root: Path) -> None:
    annots(lambda content: content["ims"][2]["ims"].reverse())(root)


GREY = np.zeros((40, 40), np.uint8)
BAD = {
    "no annots": (remove("annots.npy"), "is not a ZJU-MoCap subject: it has no annots.npy"),
    "annots cut": (cut("annots.npy", 0.5), "annots.npy is not a valid .npy file"),
    "annots of code": (evil, r"annots.npy asks for (posix|nt|os)\.system"),
    "no cams": (annots(lambda c: c.pop("cams") and None), "annots.npy has no 'cams'"),
    "no D": (annots(lambda c: c["cams"].pop("D") and None), "found 3 K, 3 R, 3 T, 0 D"),
    "K of fewer cameras": (
        annots(lambda c: c["cams"].update(K=c["cams"]["K"][:2])),
        "cams must hold one K, R, T and D per camera, found 2 K, 3 R",
    ),
    "ims of fewer cameras": (
        annots(lambda c: c["ims"][0].update(ims=c["ims"][0]["ims"][:2])),
        r"ims\[0\] lists 2 images, but cams has 3 cameras.*Camera_B1, Camera_B2",
    ),
    "ims in another order": (
        swapped_lists,
        r"ims\[2\] has Camera_B3 where ims\[0\] has Camera_B1",
    ),
    "no list, wrong number of folders": (
        folder_without_list,
        r"has 3 cameras and lists no images, but there are 4 image folders \(Camera_B1, ",
    ),
    "no pictures": (
        remove("Camera_B1", "Camera_B2", "Camera_B3"),
        "no camera folder holds images; expected e.g. Camera_B1/000000.jpg",
    ),
    "T in metres": (
        cams("T", lambda T: T / 1000, None),
        r"annots.npy: T is 0.00\d+ m long .*expected 0.05-20 m; this file's T is not",
    ),
    "T in micrometres": (
        cams("T", lambda T: T * 1000, None),
        r"annots.npy: T is \S+ m long .*expected 0.05-20 m",
    ),
    "Th in millimetres": (
        every_param(lambda c: c.update(Th=c["Th"] * 1000)),
        r"cameras stand .* expected 0.5-20 m; T in .*millimetres",
    ),
    "R sheared": (cams("R", shear), r"camera Camera_B2 \(index 1\): R is not a rotation"),
    "R mirrored": (cams("R", lambda R: R * [[1], [1], [-1]]), "Camera_B2 .*R mirrors"),
    "focal below 0": (
        cams("K", lambda K: K * [[1], [-1], [1]]),
        "focal lengths in K must be above",
    ),
    "D of 3": (cams("D", lambda D: D[:3]), "dist must hold 4, 5 or 8 finite numbers"),
    "K NaN": (cams("K", lambda K: K * np.nan), "'K' must hold finite numbers"),
    "no parameters": (
        remove("new_params"),
        "has no SMPL parameters; expected one of .*new_params/",
    ),
    "no common frame": (
        lambda root: [p.rename(p.with_name(f"9{p.name}")) for p in (root / "new_params").iterdir()],
        r"new_params has no parameters of any frame that has images; it holds 4 files",
    ),
    "poses of 66": (params(poses=np.zeros((1, 66))), r"2.npy: 'poses' must hold 72 or 69 numbers"),
    "root turned twice": (
        params(poses=np.full((1, 72), 0.1)),
        "2.npy: the first 3 numbers of 'poses' must be 0, found up to 0.1; .* belongs in Rh",
    ),
    "shapes of 16": (params(shapes=np.zeros((1, 16))), r"'shapes' must hold 10 numbers, found \(1"),
    "Th of 2": (params(Th=np.zeros((1, 2))), "'Th' must hold 3 numbers"),
    "Rh NaN": (params(Rh=np.full((1, 3), np.nan)), "'Rh' must hold finite numbers"),
    "poses text": (params(poses="none"), "'poses' must hold 72 or 69 numbers, found str"),
    "no Rh": (
        lambda root: edit(root / "new_params/2.npy", lambda c: c.pop("Rh") is None),
        "2.npy has no 'Rh'",
    ),
    "parameters cut": (cut("new_params/1.npy", 0.7), "1.npy is not a valid .npy file"),
    "pictures of another release": (
        moved_body,
        "the projected body and the masks do not meet .*check that cameras, SMPL parameters",
    ),
    "no masks": (remove("mask", "mask_cihp"), "100% of all 12 images have no mask"),
    "mask 16 bit": (
        lambda root: write_picture(root / "mask/Camera_B1/000000.png", GREY.astype(np.uint16)),
        "000000.png (holds uint16|has 16 bits)",
    ),
    "mask size": (
        picture("mask_cihp/Camera_B2/000000.png", np.ones((20, 20), np.uint8)),
        "000000.png is",
    ),
    "image empty": (
        lambda root: (root / "Camera_B3/000000.jpg").write_bytes(b""),
        "000000.jpg is not a valid PNG or JPEG",
    ),
    "image of another size": (
        picture("Camera_B3/000000.jpg", np.zeros((20, 30, 3), np.uint8)),
        "is 40x40 pixels .* has 30x20",
    ),
    "frame twice": (
        lambda root: shutil.copy(root / "Camera_B1/000001.jpg", root / "Camera_B1/0001.jpg"),
        "holds frame 1 twice",
    ),
    "leads out of the folder": (
        annots(lambda c: [e.update(ims=["../x/0.jpg", *e["ims"][1:]]) for e in c["ims"]] and None),
        "which is not a folder in it",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_damage_is_refused_in_one_sentence(original: Path, smpl_file: Path, name: str) -> None:
    damage, message = BAD[name]
    damage(original)
    with pytest.raises(DataError, match=message) as caught:
        read(original, smpl_file)
    assert "\n" not in str(caught.value)
    assert str(original) in str(caught.value)
    assert not Path("/tmp/never").exists()


def test_joints_need_a_model_file(written: Path) -> None:
    with pytest.raises(DataError, match=r"SMPL parameters but no joints.*data.smpl=/path"):
        read(written, None)


def test_model_files_that_do_not_fit(written: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data.smpl=.*none.pkl does not exist"):
        read(written, tmp_path / "none.pkl")
    write_smpl(tmp_path / "x.npz", "smplx", vertices=60)
    with pytest.raises(DataError, match=r"x.npz is a model of 55 joints.*SMPL \(24 joints\)"):
        read(written, tmp_path / "x.npz")
    write_smpl(tmp_path / "small.pkl", vertices=60)
    with pytest.raises(DataError, match=r"small.pkl has 60 vertices; expected the 6890 of SMPL"):
        read(written, tmp_path / "small.pkl")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"masks": "all"}, "data.reader.masks must be one of both, mask_cihp, mask, got 'all'"),
        ({"fit": "best"}, "data.reader.fit must be one of auto, refit, refined, first"),
        ({"drop_frames": "a-b"}, "data.reader.drop_frames must be frame numbers"),
        ({"drop_frames": "0-9"}, "leaves no frame"),
    ],
)
def test_settings_that_cannot_be(
    written: Path, smpl_file: Path, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        read(written, smpl_file, **settings)


@pytest.mark.parametrize("name", ["mesh_infos.pkl", "cam_params.json"])
def test_caches_of_other_projects_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(DataError, match=r"HumanNeRF or ARAH prepared.* give the original"):
        read(tmp_path, None)


def test_a_size_that_the_headers_did_not_show_is_found_on_decoding(
    original: Path, smpl_file: Path
) -> None:
    layout = read(original, smpl_file)
    write_picture(original / "Camera_B1/000001.jpg", np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(DataError, match=r"000001.jpg is 20x20 pixels .* Camera_B1 has 40x40"):
        frame_of(layout, 0, 1)


def test_boxes() -> None:
    assert box_iou((0, 0, 2, 2), (0, 0, 2, 2)) == 1
    assert box_iou((0, 0, 2, 2), (1, 0, 3, 2)) == pytest.approx(1 / 3)
    assert box_iou((0, 0, 1, 1), (5, 5, 6, 6)) == 0
    mask = np.zeros((8, 9), np.uint8)
    assert mask_box(mask) is None
    mask[2:4, 5:7] = 255
    assert mask_box(mask) == (5, 2, 7, 4)


def test_files_are_found_by_number(tmp_path: Path) -> None:
    assert frame_files(tmp_path, "none", (".png",)) == {}
    (tmp_path / "a").mkdir()
    for name in ("f_10.png", "f_2.PNG", ".f_3.png", "f_4.txt"):
        (tmp_path / "a" / name).touch()
    assert frame_files(tmp_path, "a", (".png",)) == {10: "a/f_10.png", 2: "a/f_2.PNG"}
    assert re.fullmatch(r"a/f_\d+\.\w+", frame_files(tmp_path, "a", (".png",))[2])


def test_the_config_trains_with_segmentation_on_cihp_labels(
    compose, written: Path, smpl_file: Path
) -> None:
    from gsgan.train.runs import build_avatar, build_data

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
    assert (info.body, info.n_labels, info.skeleton_source) == ("smpl", 20, "smpl24 -> mediapipe33")
    avatar = build_avatar(config, data).eval()
    assert avatar.segmentation is not None
    painting = avatar.paint(data.dataset("train")[0])
    assert painting.segmentation is not None
    assert "class vote over 9 images" in avatar.segmentation_why
    assert painting.segmentation.shape == (1, avatar.segmentation.classes, 32, 32)
    assert set(avatar.segmentation.map.names) < set(CIHP)
    assert painting.image is not None
    assert torch.isfinite(painting.image).all()


def test_a_run_is_scored_with_its_model_file_elsewhere(
    written: Path, smpl_file: Path, tmp_path: Path, inside
) -> None:
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
    assert f"{first} does not exist, the body model file of" in " ".join(gone.stderr.split())
    assert "data_smpl=<where it is now>" in " ".join(gone.stderr.split())
    (run / "metrics.json").unlink()
    found = inside("evaluate", f"run={run}", f"data_smpl={now}")
    assert found.returncode == 0, found.stderr
    assert json.loads((run / "metrics.json").read_text()) == json.loads(before)
