"""Bad input seen in practice: every row of the list, and the test that corrupts real files so.

`ROWS` names for each row the tests that make it ("module: test", or "module: test[key]" for a key
of a table of damages); a test here finds them. What holds for every format is damaged below in
every format that has a writer.
"""

from __future__ import annotations

import ast
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from formats_list import FORMATS, Format
from writers.common import Subject
from writers.easymocap import write_calibration, write_easymocap

from gsgan.data.checks import Checks
from gsgan.data.formats.easymocap import EasymocapReader
from gsgan.utils.errors import DataError

TESTS = Path(__file__).parents[1]
ROWS: dict[str, tuple[str, ...]] = {
    "ZJU: masks missing, mask without mask_cihp": (
        "data/test_zju.py: test_some_missing_masks_are_left_out_and_counted",
        "data/test_zju.py: test_one_of_the_two_masks_is_enough",
        "data/test_zju.py: BAD[no masks]",
    ),
    "ZJU: wrong masks in some frames": (
        "data/test_zju.py: test_a_mask_of_odd_area_is_noted_and_can_be_left_out",
    ),
    "ZJU: 21 or 23 cameras, an index that is not there": (
        "data/test_zju.py: test_21_cameras_keep_their_own_numbers",
        "data/test_zju.py: BAD[ims of fewer cameras]",
        "data/test_protocol.py: test_camera_names_and_indices",
    ),
    "ZJU: annots without ims, annots_new, backslashes, frames from 1": (
        "data/test_zju.py: test_the_refined_release",
        "data/test_zju.py: test_subjects_313_and_315",
        "data/test_zju.py: BAD[no list, wrong number of folders]",
    ),
    "ZJU: millimetres taken for metres": (
        "data/test_zju.py: BAD[T in metres]",
        "data/test_zju.py: BAD[T in micrometres]",
        "data/test_zju.py: test_a_person_far_off_is_a_matter_of_units",
    ),
    "ZJU: parameters and vertices of two fits, pictures of another release": (
        "data/test_zju.py: BAD[vertices of another fit]",
        "data/test_zju.py: BAD[pictures of another release]",
    ),
    "ZJU: parameters of a wrong length, NaN": (
        "data/test_zju.py: BAD[poses of 66]",
        "data/test_zju.py: BAD[shapes of 16]",
        "data/test_zju.py: BAD[Th of 2]",
        "data/test_zju.py: BAD[Rh NaN]",
    ),
    "THuman, AvatarReX: missing files, masks of another size or kind": (
        "data/test_thuman4.py: test_listed_files_are_left_out_of_every_split",
        "data/test_thuman4.py: test_a_damaged_picture_is_named",
        "data/test_thuman4.py: test_a_mask_of_another_size",
        "data/test_thuman4.py: test_a_mask_that_is_a_picture",
        "data/test_avatarrex.py: test_the_list_of_missing_files_is_optional_and_names_serials",
        "data/test_avatarrex.py: test_a_mask_of_another_size",
    ),
    "THuman, AvatarReX: parameters of SMPL, other cameras, a transposed size": (
        "data/test_thuman4.py: test_parameters_of_smpl",
        "data/test_thuman4.py: test_cameras_and_folders_are_the_same_ones",
        "data/test_thuman4.py: test_a_transposed_size",
        "data/test_avatarrex.py: test_a_camera_without_a_folder_or_without_calibration",
        "data/test_avatarrex.py: test_a_transposed_size",
    ),
    "EasyMocap: order of names, none, no size, no lens, no person, zeros": (
        "data/test_easymocap.py: test_cameras_are_paired_by_name",
        "data/test_bad_input_list.py: test_easymocap_without_sizes_takes_them_from_pictures",
        "data/test_easymocap.py: test_a_lens_that_is_not_said_is_none_and_noted",
        "data/test_easymocap.py: test_a_person_who_is_missing",
        "data/test_easymocap.py: test_joints_without_confidence_are_unknown",
    ),
    "Pose2Sim: units, axes, filled gaps, fewer markers, order of cameras": (
        "prepare/test_prepare_points3d.py: test_trc_units_axes_and_names_are_undone",
        "prepare/test_prepare_points3d.py: test_zeros_of_gap_filling_are_missing",
        "prepare/test_prepare_points3d.py: test_last_values_of_gap_filling_are_taken_out",
        "prepare/test_prepare_run.py: test_joints_of_another_tool_take_the_place_of_detections",
        "prepare/test_prepare_pairing.py: test_same_names_whatever_their_order",
    ),
    "own: frame counts, frame rates, rotation, clocks": (
        "data/test_capture.py: test_frames_pair_by_number_not_by_position",
        "prepare/test_prepare_doubts.py: test_sources_that_differ",
        "prepare/test_prepare_solve.py: test_a_late_clock_is_measured",
        "check/test_corruptions.py: test_a_camera_out_of_step_is_named",
    ),
    "own: swapped sides, several people, NaN, far joints, wrong bones": (
        "prepare/test_prepare_solve.py: test_planted_flips_are_found_and_put_right",
        "prepare/test_prepare_doubts.py: test_empty_frames_crowds_and_frozen_joints",
        "prepare/test_prepare_solve.py: test_cleansing_takes_out_what_no_body_has",
        "data/test_capture.py: test_missing_joints_stand_in_from_the_nearest_frame",
        "check/test_corruptions.py: test_left_and_right_exchanged_in_some_frames_are_named",
    ),
    "own: file names of dates and time stamps": (
        "data/test_capture.py: BAD_INDEX[frame of a date]",
        "data/test_meeting.py: test_timestamps_are_no_frame_numbers",
    ),
    "any: R no rotation, focal length below 0, count of lens numbers": (
        "data/test_capture.py: BAD_INDEX[R sheared]",
        "data/test_capture.py: BAD_INDEX[R mirrored]",
        "data/test_capture.py: BAD_INDEX[K focal]",
        "data/test_capture.py: BAD_INDEX[dist length]",
        "data/test_zju.py: BAD[R sheared]",
        "data/test_zju.py: BAD[focal below 0]",
        "data/test_zju.py: BAD[D of 3]",
        "data/test_thuman4.py: test_cameras_that_cannot_be",
        "data/test_bad_input_list.py: test_easymocap_cameras_that_cannot_be",
    ),
    "any: skewed K, which is kept": (
        "data/test_capture.py: test_a_skewed_K_is_kept_and_undistorted_with_its_skew",
        "data/test_meeting.py: test_boxes_follow_skew_and_lens",
        "prepare/test_prepare_solve.py: test_undistortion_inverts_the_lens",
    ),
    "any: joints behind a camera, camera to world": (
        "data/test_capture.py: BAD_INDEX[camera turned round]",
        "data/test_capture.py: BAD_INDEX[camera to world]",
        "data/test_thuman4.py: test_millimetres_and_camera_to_world_are_found_out",
        "data/test_bad_input_list.py: test_easymocap_cameras_that_cannot_be",
    ),
    "any: pictures damaged, CMYK, 16 bits; masks of floats, 16 bits": (
        "data/test_bad_input_list.py: test_pictures_that_cannot_be",
        "data/test_pixels.py: test_masks_of_floats_are_refused",
        "data/test_capture.py: BAD_INDEX[image 16 bit]",
    ),
    "any: pickles of other classes": (
        "data/test_zju.py: BAD[annots of code]",
        "data/test_zju.py: CACHE_DAMAGE[object npz]",
        "data/test_thuman4.py: test_pickled_parameters_pass_the_gate_or_are_refused",
        "data/test_capture.py: BAD_INDEX[landmarks pickled]",
    ),
}


def names_in(path: Path) -> set[str]:
    """Tests of a module, and ``TABLE[key]`` for each key of its tables."""
    found = set[str]()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)) and isinstance(node.value, ast.Dict):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            keys = [k.value for k in node.value.keys if isinstance(k, ast.Constant)]
            found |= {f"{ast.unparse(target)}[{key}]" for key in keys}
    return found


@pytest.mark.parametrize("row", ROWS)
def test_every_row_has_its_tests(row: str) -> None:
    assert ROWS[row]
    for entry in ROWS[row]:
        module, _, name = entry.partition(": ")
        assert name in names_in(TESTS / module), entry


# --- in every format ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, subject: Subject) -> Callable[[Format], Path]:
    """A dataset in a format, written once."""
    done: dict[str, Path] = {}

    def write(kind: Format) -> Path:
        if kind.name not in done:
            done[kind.name] = tmp_path_factory.mktemp("formats") / "whole"
            kind.write(done[kind.name], subject)
        return done[kind.name]

    return write


def empty(size: tuple[int, int]) -> bytes:
    return b""


def cmyk(size: tuple[int, int]) -> bytes:
    """A JPEG header of four channels."""
    frame = struct.pack(">BHHB", 8, *size, 4) + bytes(12)
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


def deep(size: tuple[int, int]) -> bytes:
    """A PNG of 16 bits, whatever the file is called."""
    return cv2.imencode(".png", np.zeros(size, np.uint16))[1].tobytes()


@pytest.mark.usefixtures("model_once")
@pytest.mark.parametrize("kind", FORMATS, ids=lambda kind: kind.name)
def test_pictures_that_cannot_be(
    kind: Format, written: Callable[[Format], Path], smpl_file: Path, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(written(kind), tmp_path / "data"))
    layout = kind.read(root, smpl_file)
    camera = next(c for c, files in layout.images.items() if files)
    frame = next(iter(layout.images[camera]))
    image, mask = layout.image_path(camera, frame), layout.mask_path(camera, frame)
    damages: tuple[tuple[Path, Callable[[tuple[int, int]], bytes], str], ...] = (
        (image, empty, "is not a valid PNG or JPEG"),
        (image, cmyk, "is a CMYK JPEG"),
        (image, deep, "has 16 bits a channel"),
        (mask, deep, "has 16 bits a channel"),
    )
    for path, damage, told in damages:
        whole = path.read_bytes()
        path.write_bytes(damage(layout.cameras[camera].size))
        with pytest.raises(DataError, match=told) as caught:
            kind.read(root, smpl_file)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
        path.write_bytes(whole)


# --- EasyMocap ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"K": np.diag([-50.0, 50.0, 1.0])}, "camera 2: the focal lengths in K must be above 0"),
        ({"dist": np.zeros(3)}, "camera 2: dist must hold 4, 5 or 8"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "camera 2: R mirrors"),
        ({"R": np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])}, "camera 2: R is not a rotation"),
        ({"t": np.array([0.0, 0.0, -3.0])}, "of the joints lie behind it|joints inside the pic"),
    ],
)
def test_easymocap_cameras_that_cannot_be(
    subject: Subject, tmp_path: Path, values: dict[str, np.ndarray], told: str
) -> None:
    root = write_easymocap(tmp_path / "e", subject)
    cameras = list(subject.cameras)
    cameras[1] = replace(cameras[1], **values)
    write_rig(root, replace(subject, cameras=tuple(cameras)))
    with pytest.raises(DataError, match=told) as caught:
        EasymocapReader()(root, Checks())
    assert "\n" not in str(caught.value)


def write_rig(root: Path, subject: Subject) -> None:
    """The calibration anew, with Rot alone: R as a vector can be nothing but a rotation."""
    write_calibration(root, subject)
    text = (root / "extri.yml").read_text()
    parts = text.split("\nR_")
    whole = [part.partition("\nRot_")[2] for part in parts[1:]]
    (root / "extri.yml").write_text("\nRot_".join([parts[0], *whole]))


def test_easymocap_without_sizes_takes_them_from_pictures(subject: Subject, tmp_path: Path) -> None:
    root = write_easymocap(tmp_path / "e", subject)
    write_calibration(root, subject, sizes=False)
    sizes = {camera.size for camera in EasymocapReader()(root, Checks()).cameras.values()}
    assert sizes == {(40, 40)}
