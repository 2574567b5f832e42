"""Masks, calibrations and landmarks as other programs write them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from make import write_tiny_capture
from writers.easymocap import write_opencv

from gsgan.data.calibration import read_calibration
from gsgan.data.cameras import numbers
from gsgan.data.formats.capture import CaptureReader
from gsgan.data.pixels import PixelRules, read_mask
from gsgan.data.validation import Thresholds
from gsgan.prepare.landmarks import read_detections
from gsgan.prepare.options import Inputs
from gsgan.prepare.run import with_detections
from gsgan.prepare.sources import Recording
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_json
from gsgan.utils.frame_files import counting
from gsgan.utils.image_files import read_colour

SOFT = np.tile(np.arange(0, 256, 8, dtype=np.uint8), (24, 1))


def mask_of(path: Path, rule: str = "grey") -> np.ndarray:
    return read_mask([(rule, path)], PixelRules(composed=False))


@pytest.mark.parametrize("colour", [0, 255])
def test_a_mask_in_the_alpha_channel_is_read(tmp_path, colour):
    image = np.full((*SOFT.shape, 4), colour, np.uint8)
    image[..., 3] = SOFT
    cv2.imwrite(str(tmp_path / "m.png"), image)
    np.testing.assert_array_equal(mask_of(tmp_path / "m.png"), SOFT)


def test_the_alpha_of_a_cut_out_person_is_the_mask(tmp_path):
    colours = np.random.default_rng(0).integers(0, 256, (*SOFT.shape, 3))
    image = np.dstack([colours.astype(np.uint8), SOFT])
    cv2.imwrite(str(tmp_path / "m.png"), image)
    np.testing.assert_array_equal(mask_of(tmp_path / "m.png"), SOFT)


def test_a_mask_in_the_colours_is_read_whatever_its_alpha(tmp_path):
    image = np.dstack([SOFT, SOFT, SOFT, np.full_like(SOFT, 255)])
    cv2.imwrite(str(tmp_path / "m.png"), image)
    np.testing.assert_array_equal(mask_of(tmp_path / "m.png"), SOFT)


@pytest.mark.parametrize("value", [1, 100, 127, 200])
def test_masks_of_another_value_than_white_are_named(tmp_path, value):
    cv2.imwrite(
        str(tmp_path / "m.png"), np.where(SOFT > 99, value, 0).astype(np.uint8)
    )
    with pytest.raises(DataError, match=rf"m\.png.* {value} "):
        mask_of(tmp_path / "m.png")


@pytest.mark.parametrize("colour", [(0, 255, 0), (0, 165, 255), (255, 0, 0)])
def test_masks_of_one_colour_are_read(tmp_path, colour):
    """Their grey value would make the person transparent."""
    filled = (SOFT > 99)[..., None] * np.array(colour, np.uint8)
    cv2.imwrite(str(tmp_path / "m.png"), filled)
    np.testing.assert_array_equal(
        mask_of(tmp_path / "m.png"), np.where(SOFT > 99, 255, 0)
    )


def test_masks_of_a_dark_colour_are_named(tmp_path):
    filled = (SOFT > 99)[..., None] * np.array((0, 0, 90), np.uint8)
    cv2.imwrite(str(tmp_path / "m.png"), filled)
    with pytest.raises(DataError, match=r"m\.png.*black and white"):
        mask_of(tmp_path / "m.png")


@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
def test_json_of_windows_editors_is_read(tmp_path, code):
    path = tmp_path / "a.json"
    path.write_bytes('{"größe": 1}'.encode(code))
    assert read_json(path) == {"größe": 1}


def test_matrices_may_be_nine_numbers():
    K = [[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]
    flat = np.ravel(K).tolist()
    np.testing.assert_array_equal(numbers("a", flat, "K", (3, 3)), K)
    with pytest.raises(DataError, match=r"'K'.*\(3, 3\)"):
        numbers("a", [900.0, 320, 240], "K", (3, 3))


def test_an_image_of_more_than_8_bits_is_named(tmp_path):
    """Divided by 256, 12 bits are black."""
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.full((4, 4, 3), 4000, np.uint16))
    with pytest.raises(DataError, match=r"a\.png has 16 bits"):
        read_colour(path)


def test_an_empty_mask_and_a_faint_soft_one_are_masks(tmp_path):
    for values in (np.zeros_like(SOFT), SOFT // 4):
        cv2.imwrite(str(tmp_path / "m.png"), values)
        np.testing.assert_array_equal(mask_of(tmp_path / "m.png"), values)


# -- calibrations


def test_yaml_without_its_directive_is_read(tmp_path):
    names = ["cam01", "cam02"]
    matrices = {"K": np.eye(3), "R": np.zeros((3, 1)), "T": np.zeros((3, 1))}
    for file, keys in (("intri.yml", "K"), ("extri.yml", "RT")):
        values = {
            f"{key}_{name}": matrices[key] for name in names for key in keys
        }
        write_opencv(tmp_path / file, names, values)
        _, rest = (tmp_path / file).read_text().split("\n", 1)
        (tmp_path / file).write_text(rest)
    assert list(read_calibration(tmp_path / "intri.yml").cameras) == names


# -- landmarks


def test_zeros_in_a_capture_are_missing(tmp_path):
    root = write_tiny_capture(tmp_path)
    path = root / "landmarks3d.npz"
    arrays = dict(np.load(path))
    arrays["p"][1, 13] = 0
    np.savez(path, **arrays)
    landmarks = CaptureReader()(root, Thresholds()).landmarks
    frame = int(arrays["frame_id"][1])
    assert float(landmarks.visibility[frame][13]) == 0


def write_frames(folder: Path, people: list) -> Path:
    folder.mkdir()
    for i in range(2):
        (folder / f"cam_{i:06d}_keypoints.json").write_text(
            json.dumps({"people": people})
        )
    return folder


def triples(count: int) -> list[float]:
    return [
        x for joint in range(count) for x in (10.0 + joint, 20.0 + joint, 0.9)
    ]


def test_null_people_are_nobody(tmp_path):
    person = {"pose_keypoints_2d": triples(25)}
    alone = read_detections(write_frames(tmp_path / "alone", [None]))
    assert (alone.conf == 0).all()
    both = read_detections(write_frames(tmp_path / "both", [None, person]))
    one = read_detections(write_frames(tmp_path / "one", [person]))
    np.testing.assert_array_equal(both.px, one.px)


def test_the_keys_of_2017_are_read_and_unknown_ones_named(tmp_path):
    old = read_detections(
        write_frames(tmp_path / "old", [{"pose_keypoints": triples(25)}])
    )
    new = read_detections(
        write_frames(tmp_path / "new", [{"pose_keypoints_2d": triples(25)}])
    )
    np.testing.assert_array_equal(old.px, new.px)
    with pytest.raises(DataError, match=r"keypoints\.json.*joints2d"):
        read_detections(
            write_frames(tmp_path / "other", [{"joints2d": triples(25)}])
        )


def test_openposes_18_joints(tmp_path):
    found = read_detections(
        write_frames(tmp_path / "coco", [{"pose_keypoints_2d": triples(18)}])
    )
    # MediaPipe's nose, left shoulder, right wrist, left hip: OpenPose's 0, 5, 4, 11
    for landmark, joint in ((0, 0), (11, 5), (16, 4), (23, 11)):
        np.testing.assert_allclose(
            found.px[0, landmark], [10.5 + joint, 20.5 + joint]
        )


def body_25b() -> tuple[np.ndarray, list[float]]:
    """COCO's 17 joints of a person, and the same in BODY_25B with a neck, a head and feet."""
    rng = np.random.default_rng(0)
    coco = np.array([[50, 10], [52, 8], [48, 8], [54, 9], [46, 9], [60, 25], [40, 25], [65, 40],
                     [35, 40], [68, 55], [32, 55], [56, 60], [44, 60], [56, 80], [44, 80],
                     [56, 98], [44, 98]]) + rng.uniform(0, 1, (17, 2))  # fmt: skip
    rest = np.array([[50, 22], [50, 4], [58, 102], [60, 101], [55, 101], [42, 102], [40, 101],
                     [45, 101]])  # fmt: skip
    whole = np.concatenate([coco, rest])
    return coco, [x for x, y in whole.tolist() for x in (x, y, 0.9)]


def test_body_25b_is_told_from_body_25_by_the_middle_of_the_hips(tmp_path):
    coco, person = body_25b()
    found = read_detections(
        write_frames(tmp_path / "b", [{"pose_keypoints_2d": person}])
    )
    for landmark, joint in ((0, 0), (11, 5), (16, 10), (23, 11), (28, 16)):
        np.testing.assert_allclose(found.px[0, landmark], coco[joint] + 0.5)
    np.testing.assert_allclose(
        found.px[0, 32], [42.5, 102.5]
    )  # the right big toe


def test_25_joints_without_hips_are_doubtful(tmp_path):
    """Of either set: both are then the same numbers."""
    _, person = body_25b()
    told = write_frames(tmp_path / "told", [{"pose_keypoints_2d": person}])
    assert read_detections(told).notes == ()
    person[3 * 12 + 2] = 0.0
    untold = write_frames(tmp_path / "untold", [{"pose_keypoints_2d": person}])
    (note,) = read_detections(untold).notes
    assert "read as BODY_25, which cannot be told from BODY_25B" in note

    # The note is printed with those on the other inputs.
    video = Recording("a", Path("a.mp4"), (8, 8), 30.0, {}, 2)
    inputs = Inputs({"a": video, "b": video}, None, (), ["first"], 30.0)
    inputs, detections = with_detections(inputs, {"a": told, "b": untold})
    assert inputs.notes == ["first", f"b: {note}"]
    assert list(detections) == ["a", "b"]
    others = write_frames(
        tmp_path / "others", [{"pose_keypoints_2d": triples(18)}]
    )
    assert read_detections(others).notes == ()


def test_masks_of_another_suffix_are_named(tmp_path):
    root = write_tiny_capture(tmp_path)
    for path in (root / "masks").rglob("*.png"):
        path.rename(path.with_suffix(".webp"))
    with pytest.raises(
        DataError, match=r"save the \.webp files there as \.png"
    ):
        CaptureReader()(root, Thresholds())


def test_one_camera_that_counts_from_another_start_is_noted(tmp_path):
    root = write_tiny_capture(tmp_path)
    camera = sorted((root / "images").iterdir())[-1]
    for path in sorted(camera.iterdir(), reverse=True):
        number = int(path.stem) + 1
        path.rename(path.with_stem(f"{number:06d}"))
    notes = CaptureReader()(root, Thresholds()).notes
    assert any(f"images of {camera.name} are numbered from" in n for n in notes)


@pytest.mark.parametrize("name", ["cameras.json", "landmarks3d.npz"])
def test_empty_files_are_called_empty(tmp_path, name):
    root = write_tiny_capture(tmp_path)
    (root / name).write_bytes(b"")
    with pytest.raises(DataError, match=rf"{name} is empty \(0 bytes\)"):
        CaptureReader()(root, Thresholds())


def test_times_beside_the_number_of_the_frame_do_not_count():
    stems = [f"{k:06d}_{1698765000 + 33 * k}" for k in range(3)]
    assert list(map(counting(stems), stems)) == [0, 1, 2]


NAMES = (
    "{:06d}_0",
    "frame{:04d}_cam1",
    "cam1_frame{:04d}",
    "Frame {:d} camera 12",
    "take3_f{:03d}",
    "{:d}",
)


@pytest.mark.parametrize("name", NAMES)
def test_the_number_that_differs_counts_frames(name):
    stems = [name.format(frame) for frame in (0, 1, 10)]
    assert list(map(counting(stems), stems)) == [0, 1, 10]


@pytest.mark.parametrize("name", NAMES[1:])
def test_one_image_is_numbered_by_the_word_before_its_number(name):
    stem = name.format(7)
    assert counting([stem])(stem) == 7


def test_words_decide_which_of_two_numbers_counts_frames():
    stems = [f"frame{k:04d}_person{k % 2}" for k in range(4)]
    assert list(map(counting(stems), stems)) == [0, 1, 2, 3]
    stems = [f"{k}_view{k % 2}" for k in range(4)]
    assert list(map(counting(stems), stems)) == [0, 1, 2, 3]
