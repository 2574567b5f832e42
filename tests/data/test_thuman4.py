"""THuman4.0: what is read equals what was written."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_frames import check_cameras, check_images, check_skeletons
from make import edit_npz
from writers.common import write_picture
from writers.smpl import posed
from writers.thuman4 import write_thuman4

from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.consistency import Consistency
from gsgan.data.formats.smpl_motion import SmplMotion
from gsgan.data.formats.smplx_rig import read_missing
from gsgan.data.formats.thuman4 import Thuman4Reader
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_ignored, read_mask
from gsgan.data.validation import Thresholds
from gsgan.utils.errors import ConfigError

pytestmark = pytest.mark.usefixtures("model_once")

NO_LOOK = Consistency(frames=0)


def read(root: Path, smplx: Path | None, **settings: Any) -> Layout:
    return Thuman4Reader(**settings)(
        root, Thresholds(), None if smplx is None else str(smplx)
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory, smplx_subject):
    """A subject with nothing missing; do not write into it."""
    return write_thuman4(
        tmp_path_factory.mktemp("thuman4") / "subject00", smplx_subject
    )


def test_read_equals_written(written, smplx_subject, smplx_file):
    layout, s = read(written, smplx_file), smplx_subject
    assert layout.camera_names == ("cam00", "cam01", "cam02")
    assert layout.frames == (0, 1, 2, 3)
    assert layout.cameras["cam00"].size == (44, 52)  # imgSize is [52, 44]
    check_cameras(layout, s.cameras)
    assert not any(camera.distorted for camera in layout.cameras.values())
    (note,) = layout.notes
    assert note.startswith(
        f"0 images named in {written / 'missing_img_files.txt'} are left out, 0 "
    )
    check_images(layout, s)
    check_skeletons(layout, s, "smplx")
    for i, frame in enumerate(s.frames):
        face = s.params["expression"][i : i + 1].astype(np.float64)
        theta, transl = (
            layout.poses.theta[frame][None],
            layout.poses.transl[frame][None],
        )
        motion = SmplMotion(
            np.array([frame]),
            theta,
            transl,
            s.params["betas"].astype(float),
            face,
        )
        assert np.allclose(
            posed(s.model, motion)[0][0], s.vertices[i], atol=1e-6
        )
    meta = layout.meta
    assert (meta.skeleton_source, meta.up_axis, meta.fps) == (
        "smplx -> mediapipe33",
        "-z",
        30,
    )
    assert (meta.body.kind, meta.body.file) == ("smplx", str(smplx_file))
    assert np.allclose(meta.body.betas, s.params["betas"][0])


def test_hands_move_their_landmarks(root, smplx_file):
    """Without finger poses the thumbs lie elsewhere, all else stays, and it is noted."""
    bent = read(root, smplx_file)
    edit_npz(
        root / "smpl_params.npz",
        lambda arrays: [
            arrays.pop(f"{s}_hand_pose") for s in ("left", "right")
        ],
    )
    flat = read(root, smplx_file)
    assert any(
        "has no left_hand_pose and right_hand_pose" in note
        for note in flat.notes
    )
    moved = np.linalg.norm(bent.landmarks.p[3] - flat.landmarks.p[3], axis=-1)
    moved[bent.landmarks.visibility[3] == 0] = 0  # stand-ins
    assert np.flatnonzero(moved > 2e-3).tolist() == [21, 22]
    assert moved[:21].max() < 1e-12
    assert (flat.poses.theta[3][25:] == 0).all()


def test_only_the_first_row_of_betas_counts(root, smplx_subject, smplx_file):
    betas = smplx_subject.params["betas"]
    edit_npz(
        root / "smpl_params.npz",
        lambda arrays: arrays.update(betas=np.concatenate([betas, betas + 3])),
    )
    meta = read(root, smplx_file).meta
    assert np.allclose(meta.body.betas, betas[0])


def test_listed_files_are_left_out(tmp_path, smplx_subject, smplx_file):
    listed = (
        "images\\cam01\\00000002.jpg",
        "./cam02/00000003.jpg",
        "",
        "cam00/00000099.jpg",
    )
    root = write_thuman4(tmp_path / "s", smplx_subject, listed)
    layout = read(root, smplx_file)
    named = read_missing(root / "missing_img_files.txt", layout.cameras)
    assert named == {("cam01", 2), ("cam02", 3), ("cam00", 99)}
    assert (2 in layout.images["cam01"], 3 in layout.images["cam02"]) == (
        False,
        False,
    )
    assert "3 images named in" in layout.notes[0]
    assert "2 of them with a file" in layout.notes[0]


def test_a_lens_is_not_applied_but_noted(tmp_path, smplx_subject, smplx_file):
    root = write_thuman4(
        tmp_path / "s", smplx_subject, distCoeff=[0.1, 0, 0, 0, 0]
    )
    layout = read(root, smplx_file)
    assert not any(camera.distorted for camera in layout.cameras.values())
    assert any(
        "gives 3 cameras lens distortion" in note for note in layout.notes
    )
    assert (
        read(root, smplx_file, undistort=True).cameras["cam00"].dist[0] == 0.1
    )


def test_frames_without_finite_parameters_are_dropped_and_named(
    root, smplx_file
):
    def change(arrays: dict[str, Any]) -> None:
        arrays["body_pose"][1, 7] = np.nan
        for key in arrays.keys() - {"betas"}:
            arrays[key] = arrays[key][:3]

    edit_npz(root / "smpl_params.npz", change)
    layout = read(root, smplx_file)
    assert layout.frames == (0, 2)
    assert any("NaN or infinity at frames 1" in note for note in layout.notes)
    assert any(
        "without a row in smpl_params.npz: 1, 3" in note
        for note in layout.notes
    )


# --- masks --------------------------------------------------------------------------------------


def test_an_alpha_of_exactly_the_threshold_is_the_person(root, smplx_file):
    path = root / "masks/cam00/00000000.jpg"
    for value, expected in ((127, 0), (128, 255)):
        write_picture(path, np.full((44, 52), value, np.uint8))
        layout = read(root, smplx_file, consistency=NO_LOOK)
        assert (
            read_mask(layout.mask_files("cam00", 0), layout.pixels) == expected
        ).all()


def test_the_ignored_band_is_an_option(root, smplx_file):
    """A half plane with a grey strip: the outline's 5 x 5 band, and alphas in between."""
    alpha = np.zeros((44, 52), np.uint8)
    alpha[:, 24:], alpha[:, :8] = 255, 100
    write_picture(root / "masks/cam00/00000000.jpg", alpha)

    def ignored(**settings: Any) -> np.ndarray | None:
        layout = read(root, smplx_file, consistency=NO_LOOK, **settings)
        files = layout.mask_files("cam00", 0)
        return read_ignored(
            files, read_mask(files, layout.pixels), layout.pixels
        )

    assert ignored() is None
    band, both = (
        ignored(ignore_band=5),
        ignored(ignore_band=5, ignore_alpha=(5, 250)),
    )
    assert np.flatnonzero(band[20]).tolist() == [22, 23, 24, 25]
    assert np.flatnonzero(both[20]).tolist() == [*range(8), 22, 23, 24, 25]
    layout = read(root, smplx_file, consistency=NO_LOOK, ignore_band=5)
    frame = CaptureDataset(layout, [("cam00", 0)], size=26)[0]
    assert frame.ignored.shape == (1, 1, 26, 26)
    assert frame.ignored.unique().tolist() == [0, 1]


def test_settings_out_of_range():
    with pytest.raises(ConfigError, match="ignore_band"):
        Thuman4Reader(ignore_band=-1)
    with pytest.raises(ConfigError, match="ignore_alpha"):
        Thuman4Reader(ignore_alpha=(250, 5))
