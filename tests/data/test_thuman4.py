"""THuman4.0: what is read equals what was written, and every damage is told in one sentence."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from make import edit_json
from writers.common import write_picture
from writers.smplx_rig import SmplxSubject
from writers.thuman4 import write_thuman4

from gsgan.data.checks import Checks
from gsgan.data.dataset import CaptureDataset
from gsgan.data.files import read_colour
from gsgan.data.formats.smpl_motion import Motion, posed
from gsgan.data.formats.smplx_rig import read_missing, read_motion
from gsgan.data.formats.thuman4 import Thuman4Reader
from gsgan.data.formats.trust import Trust
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_mask, read_unsure
from gsgan.data.splits import make_splits
from gsgan.skeleton.smpl import to_mediapipe33
from gsgan.utils.errors import ConfigError, DataError

pytestmark = pytest.mark.usefixtures("model_once")

NO_LOOK = Trust(frames=0, watched_masks=0)
LISTED = ("images\\cam01\\00000002.jpg", "./cam02/00000003.jpg", "", "cam00/00000099.jpg")


def read(root: Path, smplx: Path | None, **settings: Any) -> Layout:
    return Thuman4Reader(**settings)(root, Checks(), None if smplx is None else str(smplx))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, smplx_subject: SmplxSubject) -> Path:
    """A subject with nothing missing; do not write into it."""
    return write_thuman4(tmp_path_factory.mktemp("thuman4") / "subject00", smplx_subject)


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    """The same to damage."""
    return Path(shutil.copytree(written, tmp_path / "subject00"))


def edit_params(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Applies ``change`` to the arrays of smpl_params.npz, in place."""
    with np.load(root / "smpl_params.npz") as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(root / "smpl_params.npz", **arrays)


def edit_camera(root: Path, name: str, **values: Any) -> None:
    edit_json(root / "calibration.json", lambda content: content[name].update(values))


def refused(root: Path, smplx: Path | None, *parts: str, **settings: Any) -> None:
    """Reading ends in one sentence that has all of the parts."""
    with pytest.raises(DataError) as caught:
        read(root, smplx, **settings)
    said = str(caught.value)
    assert "\n" not in said
    for part in parts:
        assert part in said, said


# --- read equals written ------------------------------------------------------------------------


def test_cameras_are_those_that_were_written(
    written: Path, smplx_subject: SmplxSubject, smplx_file: Path
) -> None:
    layout = read(written, smplx_file)
    assert layout.camera_names == ("cam00", "cam01", "cam02")
    assert layout.frames == (0, 1, 2, 3)
    for entry, camera in zip(layout.cameras.values(), smplx_subject.cameras, strict=True):
        assert np.allclose(entry.K - camera.K, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], atol=1e-6)
        assert np.allclose(entry.R, camera.R, atol=1e-6)
        assert np.allclose(entry.t, camera.t, atol=1e-6)
        assert entry.size == (44, 52)  # imgSize is [52, 44]
        assert not entry.distorted
    assert layout.notes == ("0 images named in " + str(written / "missing_img_files.txt") + (
        " are left out, 0 of them with a file"
    ),)  # fmt: skip


def test_skeletons_and_poses_are_those_that_were_written(
    written: Path, smplx_subject: SmplxSubject, smplx_file: Path
) -> None:
    layout = read(written, smplx_file)
    s = smplx_subject
    assert layout.poses is not None
    for i, frame in enumerate(s.frames):
        p, conf = to_mediapipe33(s.joints[i], s.vertices[i], "smplx")
        seen = conf > 0
        assert np.allclose(layout.landmarks.p[frame][seen], p[seen], atol=1e-5)
        assert np.array_equal(layout.landmarks.visibility[frame], conf)
        face = s.params["expression"][i : i + 1].astype(np.float64)
        theta, transl = layout.poses.theta[frame][None], layout.poses.transl[frame][None]
        motion = Motion(np.array([frame]), theta, transl, s.params["betas"].astype(float), face)
        assert np.allclose(posed(s.model, motion)[0][0], s.vertices[i], atol=1e-6)
    meta = layout.meta
    assert (meta.skeleton_source, meta.up_axis, meta.fps) == ("smplx -> mediapipe33", "-z", 30)
    assert meta.body is not None
    assert (meta.body.kind, meta.body.file) == ("smplx", str(smplx_file))
    assert np.allclose(meta.body.betas, s.params["betas"][0])


def test_pictures_and_masks_are_those_that_were_written(
    written: Path, smplx_subject: SmplxSubject, smplx_file: Path
) -> None:
    layout = read(written, smplx_file)
    for i, frame in enumerate(smplx_subject.frames):
        for c, name in enumerate(layout.camera_names):
            alpha = smplx_subject.alphas[i][c].astype(int)
            mask = read_mask(layout.mask_files(name, frame), layout.pixels)
            clear = np.abs(alpha - 127.5) > 12  # what a JPEG at quality 100 cannot turn
            assert np.array_equal(mask[clear], np.where(alpha > 127, 255, 0)[clear])
            assert set(np.unique(mask)) <= {0, 255}
            image = read_colour(layout.image_path(name, frame)).astype(int)
            assert np.abs(image - smplx_subject.images[i][c]).mean() < 12  # chroma of a small JPEG


def test_the_projected_body_lies_on_the_mask(
    written: Path, smplx_subject: SmplxSubject, smplx_file: Path
) -> None:
    layout = read(written, smplx_file)
    frame = CaptureDataset(layout, [("cam01", 2)])[0]
    points = torch.from_numpy(smplx_subject.vertices[2]).float()[None]
    u, v = frame.camera.project(points)[0][0].floor().long().T
    on = frame.mask[0, 0][v.clamp(0, 43), u.clamp(0, 51)]
    assert on.mean() > 0.97
    assert frame.body is not None
    assert frame.body.theta.shape == (1, 55, 3)


def test_hands_move_their_landmarks(root: Path, smplx_file: Path) -> None:
    """Without finger poses the thumbs lie elsewhere, all else stays, and it is noted."""
    bent = read(root, smplx_file)
    edit_params(root, lambda arrays: [arrays.pop(f"{s}_hand_pose") for s in ("left", "right")])
    flat = read(root, smplx_file)
    assert any("has no left_hand_pose and right_hand_pose" in note for note in flat.notes)
    moved = np.linalg.norm(bent.landmarks.p[3] - flat.landmarks.p[3], axis=-1)
    moved[bent.landmarks.visibility[3] == 0] = 0  # stand-ins
    assert np.flatnonzero(moved > 2e-3).tolist() == [21, 22]
    assert moved[:21].max() < 1e-12
    assert flat.poses is not None
    assert (flat.poses.theta[3][25:] == 0).all()


def test_only_the_first_row_of_betas_counts(
    root: Path, smplx_subject: SmplxSubject, smplx_file: Path
) -> None:
    betas = smplx_subject.params["betas"]
    edit_params(root, lambda arrays: arrays.update(betas=np.concatenate([betas, betas + 3])))
    meta = read(root, smplx_file).meta
    assert meta.body is not None
    assert np.allclose(meta.body.betas, betas[0])


# --- masks --------------------------------------------------------------------------------------


def test_an_alpha_of_exactly_the_threshold_is_the_person(root: Path, smplx_file: Path) -> None:
    path = root / "masks/cam00/00000000.jpg"
    for value, expected in ((127, 0), (128, 255)):
        write_picture(path, np.full((44, 52), value, np.uint8))
        layout = read(root, smplx_file, trust=NO_LOOK)
        assert (read_mask(layout.mask_files("cam00", 0), layout.pixels) == expected).all()


def test_the_unsure_band_is_an_option(root: Path, smplx_file: Path) -> None:
    """A half plane with a grey strip: the outline's 5 x 5 band, and alphas in between."""
    alpha = np.zeros((44, 52), np.uint8)
    alpha[:, 24:], alpha[:, :8] = 255, 100
    write_picture(root / "masks/cam00/00000000.jpg", alpha)

    def unsure(**settings: Any) -> np.ndarray | None:
        layout = read(root, smplx_file, trust=NO_LOOK, **settings)
        files = layout.mask_files("cam00", 0)
        return read_unsure(files, read_mask(files, layout.pixels), layout.pixels)

    assert unsure() is None
    band, both = unsure(ignore_band=5), unsure(ignore_band=5, ignore_alpha=(5, 250))
    assert band is not None
    assert both is not None
    assert np.flatnonzero(band[20]).tolist() == [22, 23, 24, 25]
    assert np.flatnonzero(both[20]).tolist() == [*range(8), 22, 23, 24, 25]
    layout = read(root, smplx_file, trust=NO_LOOK, ignore_band=5)
    frame = CaptureDataset(layout, [("cam00", 0)], size=26)[0]
    assert frame.unsure is not None
    assert frame.unsure.shape == (1, 1, 26, 26)
    assert frame.unsure.unique().tolist() == [0, 1]
    assert CaptureDataset(read(root, smplx_file, trust=NO_LOOK), [("cam00", 0)])[0].unsure is None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ignore_band": -1}, "ignore_band must be a whole number of at least 0"),
        ({"ignore_alpha": (250, 5)}, "two rising alphas"),
    ],
)
def test_settings_out_of_range(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Thuman4Reader(**settings)


# --- bad input, one row of the list of them each ------------------------------------------------


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


def test_joints_as_triples_are_the_same(
    root: Path, smplx_subject: SmplxSubject, tmp_path: Path
) -> None:
    before = read_motion(root / "smpl_params.npz", [0, 1, 2, 3], smplx_subject.model, [])
    edit_params(root, lambda a: a.update(body_pose=a["body_pose"].reshape(4, 21, 3)))
    after = read_motion(root / "smpl_params.npz", [0, 1, 2, 3], smplx_subject.model, [])
    assert np.array_equal(before.theta, after.theta)


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


def test_frames_can_be_left_out(root: Path, smplx_file: Path) -> None:
    assert read(root, smplx_file, drop_frames="1-2").frames == (0, 3)
    with pytest.raises(ConfigError, match="leaves no frame"):
        read(root, smplx_file, drop_frames="0-9")


def test_the_config_reads_it_in_worker_processes(written: Path, smplx_file: Path, compose) -> None:
    from hydra.utils import instantiate

    config = compose(
        "train", "data=thuman4", f"data.root={written}", f"data.smpl={smplx_file}",
        "data.size=16", "data.workers=1", "data.test_cameras=[cam02]", "data.test_frames=3",
        "data.reader.ignore_alpha=[5,250]",
    )  # fmt: skip
    data = instantiate(config.data)
    batch = next(iter(data.train_dataloader()))
    assert batch.image.shape == (1, 3, 16, 16)
    assert batch.unsure is not None
    assert data.info.skeleton_source == "smplx -> mediapipe33"
    assert (data.info.body, data.info.frames) == ("smplx", 3)
    assert data.eval_names == ("novel_view", "novel_pose")
