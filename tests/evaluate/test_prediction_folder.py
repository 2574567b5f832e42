"""A folder of predictions: names, missing, repeated and extra images, broken files."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from frames import frame_of

from gsgan.evaluate.predictions import PredictionFolder, read_folder
from gsgan.scene import Frame
from gsgan.utils.errors import ConfigError, DataError

CAMERAS = ("cam1", "cam10", "B (2)")
SIZE = (6, 8)  # H, W
EXPECTED = {
    "novel_view": {("cam1", 0): SIZE, ("cam10", 5): SIZE},
    "novel_pose": {("cam1", 7): SIZE, ("B (2)", 12): SIZE},
}
DEFAULT = "{split}/{camera}/{frame}.png"
IMAGE = cv2.imencode(".png", np.zeros((*SIZE, 3), np.uint8))[1].tobytes()


def touch(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(IMAGE)
    return root


def read(root: Path, pattern: str = DEFAULT) -> PredictionFolder:
    return read_folder(root, pattern, EXPECTED, CAMERAS, "black")


ALL = (
    "novel_view/cam1/000000.png",
    "novel_view/cam10/5.png",
    "novel_pose/cam1/0007.png",
    "novel_pose/B (2)/00012.png",
)


def test_every_padding_of_a_number_is_read(tmp_path):
    folder = read(touch(tmp_path, *ALL))
    assert folder.files["B (2)", 12] == ALL[3]
    assert set(folder.files) == {
        item for items in EXPECTED.values() for item in items
    }


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("{camera}_{frame}.jpg", ("cam1_0.jpg", "cam10_05.jpg", "cam1_7.jpg", "B (2)_12.jpg")),
        ("{frame}_view{camera_index}.png",
         ("0_view0.png", "5_view1.png", "000007_view00.png", "12_view2.png")),
    ],
)  # fmt: skip
def test_patterns_without_a_split(tmp_path, pattern, names):
    folder = read(touch(tmp_path, *names), pattern)
    assert sorted(folder.files.values()) == sorted(names)


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("{camera}.png", "{frame}"),
        ("{frame}.png", "{camera}"),
        ("{camera}/{view}/{frame}.png", "{split}"),
    ],
)
def test_invalid_patterns(tmp_path, pattern, message):
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, pattern)


def test_a_missing_image_is_named(tmp_path):
    touch(tmp_path, *ALL[:3])
    expected = r"1 of 4 .*B \(2\).*novel_pose/B \(2\)/000012\.png"
    with pytest.raises(DataError, match=expected):
        read(tmp_path)


def test_a_folder_with_other_names_and_a_file_are_refused(tmp_path):
    touch(tmp_path, "view/0.png", ".DS_Store")
    with pytest.raises(DataError, match="4 of 4"):
        read(tmp_path)
    for place in ("nowhere", "view/0.png"):
        with pytest.raises(DataError, match="predictions="):
            read(tmp_path / place)


def test_a_repeated_image_is_named(tmp_path):
    touch(tmp_path, *ALL, "novel_view/cam10/005.png")
    both = r"novel_view/cam10/005\.png .*novel_view/cam10/5\.png"
    with pytest.raises(DataError, match=both):
        read(tmp_path)


def frame() -> Frame:
    mask = torch.zeros(1, 1, *SIZE)
    mask[..., 2:4, 2:5] = 1
    return frame_of(0.5 * mask.expand(1, 3, -1, -1), mask)


def one(
    tmp_path: Path,
    pixels: np.ndarray,
    name: str = "3.png",
    background: str = "black",
) -> PredictionFolder:
    assert cv2.imwrite(str(tmp_path / name), pixels)
    return PredictionFolder(tmp_path, {("cam", 3): name}, background)


def person(value: int = 128, behind: int = 0) -> np.ndarray:
    pixels = np.full((*SIZE, 3), behind, np.uint8)
    pixels[2:4, 2:5] = (10, 20, value)  # BGR
    return pixels


def test_images_are_rgb_and_keep_their_alpha(tmp_path):
    found = one(tmp_path, person()).predict(frame(), ("cam", 3))
    assert not found.alphas
    assert (found.images["full"][0, :, 2, 2] * 255).tolist() == pytest.approx(
        [128, 20, 10]
    )
    alpha = np.full((*SIZE, 1), 51, np.uint8)
    found = one(tmp_path, np.concatenate([person(), alpha], -1)).predict(
        frame(), ("cam", 3)
    )
    assert found.alphas["full"].aminmax() == pytest.approx((0.2, 0.2))
    assert float(found.images["full"][0, 0, 2, 2]) == pytest.approx(
        0.2 * 128 / 255
    )


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (person().astype(np.uint16) * 257, "16 bits"),
        (person()[..., 0], "grey"),
        (
            person()[:5],
            "8x5 .*cam, frame 3.* 8x6",
        ),
    ],
)
def test_images_of_another_kind_are_refused(tmp_path, pixels, message):
    one(tmp_path, pixels, "cam_3.png")
    expected = {"novel_pose": {("cam", 3): SIZE}}
    with pytest.raises(DataError, match=message):
        read_folder(
            tmp_path, "{camera}_{frame}.png", expected, ["cam"], "black"
        ).predict(frame(), ("cam", 3))


@pytest.mark.parametrize("kept", [0, 20, 60, -20])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_truncated_files_are_refused(tmp_path, kept, suffix):
    name = f"3.{suffix}"
    folder = one(
        tmp_path,
        np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8),
        name,
    )
    path = tmp_path / name
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(DataError, match=name):
        folder.predict(frame(), ("cam", 3))
    path.unlink()
    with pytest.raises(DataError, match=name):
        folder.predict(frame(), ("cam", 3))


def test_an_unexpected_background_is_refused(tmp_path):
    with pytest.raises(
        DataError,
        match=r"white.*black",
    ):
        one(tmp_path, person(behind=255)).predict(frame(), ("cam", 3))
    with pytest.raises(DataError, match=r"black.*white"):
        one(tmp_path, person(), background="white").predict(frame(), ("cam", 3))
    one(tmp_path, person(behind=255), background="white").predict(
        frame(), ("cam", 3)
    )
    # bad, but not the other one
    one(tmp_path, person(behind=90)).predict(frame(), ("cam", 3))
