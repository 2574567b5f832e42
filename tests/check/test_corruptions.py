"""Good data passes; every damage is found, named, and an error where training would be wasted."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from make import edit_json, edit_npz

from gsgan.skeleton.template import MEDIAPIPE33

MIRROR = list(MEDIAPIPE33.mirror)


def images(pattern: str, change):
    """Damage: images of the folder are changed."""

    def damage(root: Path) -> None:
        for path in root.glob(pattern):
            cv2.imwrite(
                str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            )

    return damage


def cameras(change):
    return lambda root: edit_json(root / "cameras.json", change)


def missing(root: Path) -> None:
    for frame in (3, 4):
        (root / f"images/cam02/{frame:06d}.png").unlink()


def only(report, level: str) -> str:
    """The one finding of a level."""
    sentences = [f.sentence for f in report.findings if f.level == level]
    assert len(sentences) == 1, sentences
    return sentences[0]


def test_a_good_capture_has_nothing_wrong(good, check):
    report = check(good)
    assert report.findings == ()
    cameras = report.numbers["cameras"]
    assert all(score["inside"] == 1 for score in cameras.values())
    assert all(
        s["overlap"] > max(s["rivals"].values()) for s in cameras.values()
    )
    assert report.numbers["camera_distance"] == pytest.approx(3.0, abs=0.1)


ERRORS = {
    "camera cam02 stands .*another unit": cameras(
        lambda rig: rig["cam02"].update(t=[1000 * x for x in rig["cam02"]["t"]])
    ),
    "camera cam01: only .*100% in the other cameras.*a crop or resize that K does not": images(
        "masks/cam01/*", lambda mask: np.roll(mask, 12, 1)
    ),
    "camera cam01: .*mirrored images.* would fit its masks better": images(
        "[im]*/cam01/*", lambda image: image[:, ::-1]
    ),
    "camera cam03: its masks are empty": images("masks/cam03/*", np.zeros_like),
    "all masks are empty .cam00, cam01": images("masks/*/*", np.zeros_like),
    "masks are white everywhere": images(
        "masks/*/*", lambda mask: np.full_like(mask, 255)
    ),
    "the inverted masks would fit": images(
        "masks/*/*", lambda mask: 255 - mask
    ),
}
WARNINGS = {
    "camera cam02 lacks 2 of the 12 frames: 3-4$": missing,
    "masks have a second piece": images(
        "masks/*/*",
        lambda mask: np.maximum(mask, np.roll(mask, mask.shape[1] // 3, 1)),
    ),
    ".*points along z, 90 degrees from the up axis y": lambda root: edit_json(
        root / "meta.json", lambda meta: meta.update(up_axis="y")
    ),
}


@pytest.mark.parametrize("named", [*ERRORS, *WARNINGS])
def test_each_damage_has_one_finding(copy, check, named):
    (ERRORS | WARNINGS)[named](copy)
    assert re.match(
        named, only(check(copy), "error" if named in ERRORS else "warning")
    )


def test_all_cameras_in_millimetres_stop_the_reader_and_are_reported(
    copy, check
):
    def scale(cameras):
        for camera in cameras.values():
            camera["t"] = [1000 * x for x in camera["t"]]

    edit_json(copy / "cameras.json", scale)
    report = check(copy)
    assert "check 'unit'" in only(report, "error")
    assert report.numbers == {"readable": False}


def test_a_truncated_image_is_found_though_few_are_sampled(copy, check):
    path = copy / "images" / "cam01" / "000005.png"
    path.write_bytes(path.read_bytes()[:-30])
    report = check(copy, images=4)
    assert str(path) in only(report, "error")


def test_all_damaged_and_missing_files_are_named_at_once(copy, check):
    broken = [copy / f"masks/cam01/{frame:06d}.png" for frame in (2, 5)]
    for path in broken:
        path.write_bytes(b"no image")
    (copy / "images/cam02/000004.png").unlink()
    text = " ".join(f.sentence for f in check(copy).findings)
    for path in broken:
        assert text.count(str(path)) == 1
    assert re.search(r"cam02 lacks 1 of 12 frames: 4", text)


def test_masks_of_jpeg_are_read_with_128_as_the_limit(copy, check):
    for path in (copy / "masks").glob("*/*.png"):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path.with_suffix(".jpg")), mask)
        path.unlink()
    assert check(copy).findings == ()


def test_images_from_1_and_masks_from_0_are_a_warning(copy, check):
    for path in sorted((copy / "images").glob("*/*"), reverse=True):
        path.rename(path.with_name(f"{int(path.stem) + 1:06d}.png"))
    text = " ".join(f.sentence for f in check(copy).findings)
    assert "images are numbered from 1, masks from 0" in text
    assert "images are numbered from 1, landmarks from 0" in text


def renumber_masks(copy: Path) -> None:
    for path in sorted((copy / "masks").glob("*/*"), reverse=True):
        path.rename(path.with_name(f"{int(path.stem) + 1:06d}.png"))


def renumber_landmarks(copy: Path) -> None:
    path = copy / "landmarks3d.npz"
    arrays = dict(np.load(path))
    np.savez(path, **arrays | {"frame_id": arrays["frame_id"] + 100})


@pytest.mark.parametrize(
    ("renumber", "others"),
    [
        (renumber_masks, "masks from 1"),
        (renumber_landmarks, "landmarks from 100"),
    ],
)
def test_images_from_0_and_others_from_elsewhere_are_named(
    copy, check, renumber, others
):
    renumber(copy)
    text = " ".join(f.sentence for f in check(copy).findings)
    assert f"images are numbered from 0, {others}" in text


@pytest.mark.parametrize("name", ["{}_0.png", "frame{}_cam1.png"])
def test_the_number_that_differs_counts_frames(copy, check, name):
    for folder in ("images", "masks"):
        for path in sorted((copy / folder).glob("*/*.png")):
            path.rename(path.with_name(name.format(path.stem)))
    assert check(copy).findings == ()


def exchange(p):
    p[5:7] = p[5:7][:, MIRROR]


def exchange_throughout(p):
    p[:] = p[:, MIRROR]


def jump(p):
    p[6, 15] += [0.5, 0, 0]


def lose(p):
    p[8, :11] = np.nan


def lose_throughout(p):
    """OpenPose's 25 points leave a third of the 33 open: no fault."""
    p[:, [1, 3, 4, 6, 9, 10, *range(17, 23)]] = np.nan


def shrink(p):
    p[:] = p * 0.5


@pytest.mark.parametrize(
    ("change", "level", "named"),
    [
        (
            exchange,
            "error",
            "left and right of the arms are exchanged in 2 of 12 frames: 5-6",
        ),
        (exchange_throughout, "error", "left and right are exchanged"),
        (
            jump,
            "warning",
            r"in 1 of 12 frames: 6 .frame 6: jumps: left_wrist 0.50 m",
        ),
        (lose, "warning", "few joints were seen in 1 of 12 frames: 8"),
        (lose_throughout, "warning", None),
        (shrink, "warning", "limb lengths suggest a person of 0.79"),
    ],
)
def test_wrong_landmarks_are_named_with_their_frames(
    copy, check, change, level, named
):
    edit_npz(copy / "landmarks3d.npz", lambda arrays: change(arrays["p"]))
    report = check(copy)
    assert report.errors == 0 or level == "error" or change is shrink
    found = [f.sentence for f in report.findings if f.level == level]
    assert [
        bool(re.search(named or "were seen", text)) for text in found
    ].count(True) == (named is not None)


@pytest.mark.parametrize(("cameras", "frames"), [(1, 1), (2, 3)])
def test_the_smallest_captures_can_be_checked(tmp_path, check, cameras, frames):
    from make import write_tiny_capture

    root = write_tiny_capture(
        tmp_path / "tiny", cameras=cameras, frames=frames, size=(48, 64)
    )
    report = check(root)
    assert report.errors == 0
    assert report.numbers["cameras"]["cam00"]["outside"] == 0


def test_lens_distortion_is_undone_before_anything_is_measured(tmp_path, check):
    from make import write_tiny_capture

    lens = {"dist": (-0.3, 0.1, 0, 0, 0), "size": (96, 96)}
    root = write_tiny_capture(tmp_path / "lens", cameras=3, frames=4, **lens)
    assert (
        min(c["inside"] for c in check(root).numbers["cameras"].values()) > 0.99
    )


def turn(root: Path, axis: tuple[float, float, float], degrees: float) -> None:
    def change(cameras):
        r = cv2.Rodrigues(np.radians(degrees) * np.array(axis))[0]
        camera = cameras["cam01"]
        camera["R"], camera["t"] = (
            (r @ camera["R"]).tolist(),
            (r @ camera["t"]).tolist(),
        )

    edit_json(root / "cameras.json", change)


def scale_focal(
    root: Path, factor: float, *names: str, centre: bool = False
) -> None:
    def change(cameras):
        for name in names:
            K = np.array(cameras[name]["K"])
            K[[0, 1], [0, 1]] *= factor
            K[:2, 2] *= factor if centre else 1
            cameras[name]["K"] = K.tolist()

    edit_json(root / "cameras.json", change)


def test_a_camera_that_is_nearly_right_is_named(copy, check):
    turn(copy, (0, 0, 1), 12)
    sentences = [
        f.sentence
        for f in check(copy, consistency={"min_inside": 0.71}).findings
    ]
    assert any(s.startswith("camera cam01: joints lie") for s in sentences)
    assert not any(
        "camera cam00" in s or "camera cam02" in s for s in sentences
    )


def test_focal_lengths_of_half_are_named(copy, check):
    names = "cam01", "cam03"
    scale_focal(copy, 0.5, *names)
    # the tiny person is of thin discs, so all is smaller than in a capture
    limits = {
        "fullness": 1.2,
        "consistency": {"min_inside": 0.3},
        "inside_error": 0.2,
    }
    errors = [
        f.sentence for f in check(copy, **limits).findings if f.level == "error"
    ]
    (found,) = (s for s in errors if "far larger than the body" in s)
    assert all(f"{name} " in found for name in names)
    assert not any("would fit" in s for s in errors)


def test_a_camera_that_training_refuses_is_explained_by_the_check(copy, check):
    scale_focal(copy, 0.5, "cam01", centre=True)
    report = check(copy)
    assert report.numbers["readable"]
    assert report.errors == 1
    assert only(report, "error").startswith("camera cam01: ")


def test_every_file_that_cannot_be_read_is_named_at_once(copy, check):
    """Not the first alone: people correct all of them before they check again."""
    (copy / "meta.json").write_text('{"unit": "ell"}')
    (copy / "cameras.json").write_text("{")
    (copy / "landmarks3d.npz").write_bytes(b"no archive")
    report = check(copy)
    messages = [finding.sentence for finding in report.findings]
    assert report.errors == len(messages) == 3
    for name in ("meta.json", "cameras.json", "landmarks3d.npz"):
        assert any(name in message for message in messages), messages


def test_a_folder_that_does_not_exist_is_one_error(tmp_path, check):
    report = check(tmp_path / "gone")
    assert "gone does not exist" in only(report, "error")
