"""The reader: the person's window, its size, and what lenses do to it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from capture_frames import every_frame, items
from make import edit_json, write_tiny_capture

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import Crop, PersonCrop, cut, square_window, undistort_map
from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.capture import read_capture
from gsgan.data.formats.consistency import Consistency
from gsgan.evaluate.predictions import Prediction
from gsgan.losses.photometric import photometric
from gsgan.utils.errors import ConfigError

LENS = (-0.25, 0.08, 0.002, -0.001, 0.01)
RATIONAL = (0.1, 0.02, 0.001, 0.002, 0.01, 0.3, 0.05, 0.01)
SPOT = np.array(
    [0.9, -0.1, 1.7]
)  # metres, where `spot_capture` puts a white spot


def spot_capture(
    root: Path, size: tuple[int, int], dist: tuple[float, ...], skew: float
) -> Path:
    """One camera whose picture shows nothing but a soft white spot at `SPOT`."""
    write_tiny_capture(
        root, cameras=1, frames=1, size=size, dist=dist or (0,) * 5
    )
    edit_json(
        root / "cameras.json",
        lambda rig: rig["cam00"]["K"][0].__setitem__(1, skew),
    )
    camera = json.loads((root / "cameras.json").read_text())["cam00"]
    x, y, z = np.array(camera["R"]) @ SPOT + camera["t"]
    ray, zero = np.array([[x / z, y / z, 1.0]]), np.zeros(3)
    bent = cv2.projectPoints(
        ray, zero, zero, np.eye(3), np.array(camera["dist"], float)
    )[0]
    # OpenCV would ignore the skew
    u, v = (np.array(camera["K"]) @ [*bent.ravel(), 1])[:2]
    rows, columns = np.mgrid[0 : size[1], 0 : size[0]] + 0.5
    spot = 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 1.5**2))
    cv2.imwrite(
        str(root / "images/cam00/000000.png"),
        np.repeat(spot.round().astype(np.uint8)[..., None], 3, -1),
    )
    cv2.imwrite(
        str(root / "masks/cam00/000000.png"), np.full(size[::-1], 255, np.uint8)
    )
    return root


def centroid(image: torch.Tensor) -> torch.Tensor:
    """(u, v) of the light in ``[3, H, W]``, pixel centres at +0.5."""
    grey = image.mean(0)
    grey = grey * (grey > 0.02)
    v, u = (torch.arange(n) + 0.5 for n in grey.shape)
    return (
        torch.stack([(grey.sum(0) * u).sum(), (grey.sum(1) * v).sum()])
        / grey.sum()
    )


@pytest.mark.parametrize(
    ("lens", "skew"),
    [((), 0), (LENS, 0), (RATIONAL, 0), (LENS[:4], 0), (LENS, 20)],
    ids=["none", "5", "8", "4", "skewed"],
)
@pytest.mark.parametrize(
    "crop", [None, PersonCrop(0.8)], ids=["full", "person"]
)
@pytest.mark.parametrize("size", [None, 60, 300])
def test_a_point_in_space_stays_on_its_spot(tmp_path, lens, skew, crop, size):
    """K, R and t of the frame put a 3D point where the picture shows it, whatever was done."""
    (frame,) = every_frame(
        spot_capture(tmp_path, (160, 120), lens, skew), crop=crop, size=size
    )
    expected, _ = frame.camera.project(
        torch.from_numpy(SPOT).float()[None, None]
    )
    assert frame.image.shape[-2:] == frame.camera.size
    assert torch.allclose(centroid(frame.image[0]), expected[0, 0], atol=0.1)


def test_lens_folding_back_shows_nothing(tmp_path):
    K, dist = (
        np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]),
        np.array([-0.3, *[0.0] * 7]),
    )
    camera = CameraEntry("a", K, np.eye(3), np.zeros(3), dist, size=(100, 100))
    mapping = undistort_map(camera, Crop(0, -150, (100, 400)))
    # r (1 - 0.3 r²) rises up to r = 1.054: column 250 is at r = 2
    assert (mapping[50, -1] < -1000).all()
    assert np.allclose(mapping[50, 200], 49.5 + np.array([0.5, 0.5]), atol=0.01)


def test_labels_are_never_mixed(tmp_path):
    root = write_tiny_capture(tmp_path, labels=True, size=(64, 48), dist=LENS)
    for path in (root / "labels").rglob("*.png"):
        labels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(
            str(path), np.where(labels == 2, 200, labels).astype(np.uint8)
        )
    for frame in every_frame(root, size=40, crop=PersonCrop()):
        assert set(frame.labels.unique().tolist()) == {0, 1, 200}


def test_the_crop_comes_from_skeleton_and_camera_alone(tmp_path):
    root = write_tiny_capture(tmp_path)
    before = read_capture(root)
    windows = [
        CaptureDataset(before, [i], crop=PersonCrop()).window(i)
        for i in items(before)
    ]
    for path in (root / "masks").rglob("*.png"):
        cv2.imwrite(str(path), np.zeros((24, 32), np.uint8))
    after = read_capture(root, consistency=Consistency(frames=0))
    blind = CaptureDataset(after, items(after), size=16, crop=PersonCrop())
    assert [blind.window(i) for i in items(after)] == windows
    assert (blind[0].image == 0).all()


def test_crop_is_square_and_has_the_margin_in_metres(tmp_path):
    layout = read_capture(
        write_tiny_capture(tmp_path, cameras=1, frames=1, size=(400, 400))
    )
    view = layout.cameras["cam00"]
    joints, usable = np.tile([0.0, 0.0, 0.9], (33, 1)), np.ones(33, bool)
    joints[0, 2] = 1.5
    window = PersonCrop(0.3).window(view, joints, usable)
    # focal 480 at 3 m is 160 px a metre: from 0.3 m below the low joint to 0.3 above the high one
    assert window == Crop(200 - 144, 200 - 96, (192, 192))
    usable[0] = False
    assert PersonCrop(0.3).window(view, joints, usable) == Crop(
        152, 152, (96, 96)
    )


def test_crop_beyond_the_border_is_black_and_follows_only_what_is_in_view(
    tmp_path,
):
    layout = read_capture(
        write_tiny_capture(tmp_path, cameras=1, frames=1, size=(400, 400))
    )
    view = layout.cameras["cam00"]
    joints, usable = np.tile([-1.2, 0.0, 0.9], (33, 1)), np.ones(33, bool)
    joints[1] = [-9.0, 0.0, 0.9]  # far out to the left
    window = PersonCrop(0.3).window(view, joints, usable)
    assert window.size == (96, 96)
    assert window.left < 0
    piece = cut(np.full((400, 400, 3), 9, np.uint8), window)
    assert (piece[:, : -window.left] == 0).all()
    assert (piece[:, -window.left :] == 9).all()
    assert (
        cut(np.ones((4, 4), np.uint8), Crop(50, 50, (3, 2))) == np.zeros((3, 2))
    ).all()


def test_crop_without_joints_in_front_is_the_whole_picture(tmp_path):
    layout = read_capture(write_tiny_capture(tmp_path))
    behind = np.tile([0.0, -50.0, 0.9], (33, 1))
    window = PersonCrop().window(
        layout.cameras["cam00"], behind, np.ones(33, bool)
    )
    assert window == square_window((24, 32)) == Crop(-4, 0, (32, 32))


@pytest.mark.parametrize("size", [0, -4, 1.5, "big"])
def test_bad_sizes(tmp_path, size):
    layout = read_capture(write_tiny_capture(tmp_path))
    with pytest.raises(ConfigError, match=r"data\.size"):
        CaptureDataset(layout, items(layout), size=size)


def cut_below(root: Path, height: int) -> None:
    """Cuts every image, mask and label of a capture at this height."""
    for path in root.rglob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), image[:height])

    def shorten(rig: dict) -> None:
        for camera in rig.values():
            camera["size"][1] = height

    edit_json(root / "cameras.json", shorten)


def test_what_is_below_the_border_of_an_image_is_unknown(tmp_path):
    root = write_tiny_capture(tmp_path / "whole", size=(48, 48), labels=True)
    whole = every_frame(root, size=48)
    cut_below(root, 26)
    cut = every_frame(root, size=48)

    # The window is padded below; the person goes on there.
    for frame, complete in zip(cut, whole, strict=True):
        unknown = frame.ignored[0, 0] > 0
        rows = unknown.all(dim=1)
        assert rows.any()
        assert not unknown[~rows].any()
        assert (frame.labels[0][unknown] == 255).all()
        assert (frame.mask[0, 0][unknown] == 0).all()
        assert complete.ignored is None

    # A person that ends inside the image does not go on beyond its border.
    for path in (root / "masks").rglob("*.png"):
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        mask[-2:] = 0
        cv2.imwrite(str(path), mask)
    for frame in every_frame(root, size=48):
        assert not frame.ignored.any()


def test_losses_and_scores_ignore_what_is_below_the_border(tmp_path):
    root = write_tiny_capture(tmp_path / "cut", size=(48, 48))
    cut_below(root, 26)
    (frame, *_) = every_frame(root, size=48)
    below = frame.ignored > 0

    # Two renderings that differ below the border alone.
    image = torch.rand(
        frame.image.shape, generator=torch.Generator().manual_seed(0)
    )
    other = torch.where(below, 1 - image, image)
    losses = []
    for one in (image, other):
        one = one.clone().requires_grad_()
        loss = photometric(
            one, frame.image, l1=1.0, ssim=0.0, ignored=frame.ignored
        )
        loss.backward()
        assert one.grad[below.expand_as(one.grad)].eq(0).all()
        losses.append(float(loss.detach()))
    assert losses[0] == losses[1]

    # Predictions are cleared there, where the ground truth is black.
    stored = (~below).float()
    prediction = Prediction({"full": image}, {"full": torch.ones_like(stored)})
    inside = prediction.inside(stored)
    assert inside.images["full"][below.expand_as(image)].eq(0).all()
    assert torch.equal(inside.alphas["full"], stored)
    opaque = Prediction({"full": image}, {"full": None}).inside(stored)
    assert torch.equal(opaque.images["full"], image)
