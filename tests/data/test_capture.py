"""The reader: what a `Frame` holds, and one sentence for each way a capture can be broken."""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from make import edit_json, ring_camera, skeletons, write_landmarks, write_tiny_capture
from PIL import Image

from gsgan.data.checks import Checks, spans
from gsgan.data.crop import Crop, PersonCrop, cut, square_window, undistort_map
from gsgan.data.dataset import CaptureDataset, Picture, PictureCache
from gsgan.data.files import cut_off, last_number, read_header
from gsgan.data.formats.capture import LOOKED_AT, read_capture
from gsgan.data.formats.trust import Trust
from gsgan.data.layout import Layout
from gsgan.data.skeletons import fill_missing
from gsgan.scene import Frame, cat
from gsgan.utils.errors import ConfigError, DataError

LENS = (-0.25, 0.08, 0.002, -0.001, 0.01)
RATIONAL = (0.1, 0.02, 0.001, 0.002, 0.01, 0.3, 0.05, 0.01)
SPOT = np.array([0.9, -0.1, 1.7])  # metres, where `spot_capture` puts a white spot


def items(layout: Layout) -> list[tuple[str, int]]:
    return [(c, f) for c in layout.cameras for f in sorted(layout.images[c])]


def every_frame(root: Path, trust: Trust = LOOKED_AT, **kwargs: object) -> list[Frame]:
    layout = read_capture(root, trust=trust)
    dataset = CaptureDataset(layout, items(layout), **kwargs)  # type: ignore[arg-type]
    return [dataset[i] for i in range(len(dataset))]


def spot_capture(root: Path, size: tuple[int, int], dist: tuple[float, ...] = ()) -> Path:
    """One camera whose picture shows nothing but a soft white spot at `SPOT`."""
    write_tiny_capture(root, cameras=1, frames=1, size=size, dist=dist or (0,) * 5)
    camera = json.loads((root / "cameras.json").read_text())["cam00"]
    x, y, z = np.array(camera["R"]) @ SPOT + camera["t"]
    u, v = distort(x / z, y / z, np.array(camera["K"]), camera["dist"])
    rows, columns = np.mgrid[0 : size[1], 0 : size[0]] + 0.5
    spot = 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 1.5**2))
    cv2.imwrite(
        str(root / "images/cam00/000000.png"),
        np.repeat(spot.round().astype(np.uint8)[..., None], 3, -1),
    )
    cv2.imwrite(str(root / "masks/cam00/000000.png"), np.full(size[::-1], 255, np.uint8))
    return root


def distort(x: float, y: float, K: np.ndarray, dist: tuple[float, ...]) -> tuple[float, float]:
    pixels = cv2.projectPoints(
        np.array([[x, y, 1.0]]), np.zeros(3), np.zeros(3), K, np.array(dist, float)
    )
    return tuple(pixels[0].ravel())


def centroid(image: torch.Tensor) -> torch.Tensor:
    """(u, v) of the light in ``[3, H, W]``, pixel centres at +0.5."""
    grey = image.mean(0)
    grey = grey * (grey > 0.02)
    v, u = (torch.arange(n) + 0.5 for n in grey.shape)
    return torch.stack([(grey.sum(0) * u).sum(), (grey.sum(1) * v).sum()]) / grey.sum()


def test_frame_holds_what_its_docstring_says(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, labels=True, body_pose=True, first_frame=7)
    frames = every_frame(root)
    assert len(frames) == 8
    frame = cat(frames)
    assert frame.image.shape == (8, 3, 24, 32)
    assert frame.image.dtype == torch.float32
    assert frame.mask.shape == (8, 1, 24, 32)
    assert frame.mask.amax() == 1
    assert frame.labels is not None
    assert frame.labels.shape == (8, 24, 32)
    assert frame.labels.dtype == torch.int64
    assert set(frame.labels.unique().tolist()) == {0, 1, 2}
    assert frame.frame_id.tolist() == [7, 8, 9, 10] * 2
    assert frame.camera_index.tolist() == [0] * 4 + [1] * 4
    assert frame.camera.dist is None
    assert frame.body is not None
    assert frame.body.theta.shape == (8, 56, 3)
    assert torch.allclose(frame.body.theta[:, 0, 2], 0.1 * frame.frame_id)
    expected = torch.from_numpy(skeletons(4)).float()
    assert torch.allclose(frame.skeleton, torch.cat([expected, expected]))
    assert (frame.visibility == 1).all()


def test_colours_are_rgb_and_the_background_is_black(tmp_path: Path) -> None:
    frame = every_frame(write_tiny_capture(tmp_path))[0]
    person = (frame.mask[0, 0] == 1) & (frame.image[0, 0] > 0.5)
    assert person.sum() > 10
    red, green, blue = frame.image[0][:, person]
    assert torch.allclose(red, torch.full_like(red, 200 / 255))  # drawn as RGB (200, 40.., 60)
    assert torch.allclose(blue, torch.full_like(blue, 60 / 255))
    assert (green <= 200 / 255).all()
    assert (frame.image[0][:, frame.mask[0, 0] == 0] == 0).all()  # the wall was grey


def test_soft_masks_mix_with_black_once(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, cameras=1, frames=1)
    cv2.imwrite(str(root / "images/cam00/000000.png"), np.full((24, 32, 3), 100, np.uint8))
    cv2.imwrite(str(root / "masks/cam00/000000.png"), np.full((24, 32), 51, np.uint8))
    trust = Trust(frames=0)  # no pixel of such a mask counts as the person
    assert torch.allclose(every_frame(root, trust)[0].image, torch.tensor(20 / 255))
    edit_json(root / "meta.json", lambda meta: meta.update(background="black"))
    assert torch.allclose(every_frame(root, trust)[0].image, torch.tensor(100 / 255))


@pytest.mark.parametrize("lens", [(), LENS, RATIONAL, LENS[:4]], ids=["none", "5", "8", "4"])
@pytest.mark.parametrize("crop", [None, PersonCrop(0.8)], ids=["full", "person"])
@pytest.mark.parametrize("size", [None, 60, 300])
def test_a_point_in_space_stays_on_its_spot(
    tmp_path: Path, lens: tuple[float, ...], crop: PersonCrop | None, size: int | None
) -> None:
    """K, R and t of the frame put a 3D point where the picture shows it, whatever was done."""
    (frame,) = every_frame(spot_capture(tmp_path, (160, 120), lens), crop=crop, size=size)
    expected, _ = frame.camera.project(torch.from_numpy(SPOT).float()[None, None])
    assert frame.image.shape[-2:] == frame.camera.size
    assert torch.allclose(centroid(frame.image[0]), expected[0, 0], atol=0.1)


def test_distortion_matters_in_that_test(tmp_path: Path) -> None:
    root = spot_capture(tmp_path, (160, 120), LENS)
    edit_json(root / "cameras.json", lambda rig: rig["cam00"].update(dist=[0] * 5))
    (frame,) = every_frame(root)
    expected, _ = frame.camera.project(torch.from_numpy(SPOT).float()[None, None])
    assert (centroid(frame.image[0]) - expected[0, 0]).norm() > 0.5


def test_lens_folding_back_shows_nothing(tmp_path: Path) -> None:
    K, dist = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), np.array([-0.3, *[0.0] * 7])
    mapping = undistort_map(K, dist, Crop(0, -150, (100, 400)))
    # r (1 - 0.3 r²) rises up to r = 1.054: column 250 is at r = 2
    assert (mapping[50, -1] < -1000).all()
    assert np.allclose(mapping[50, 200], 49.5 + np.array([0.5, 0.5]), atol=0.01)


def test_labels_are_never_mixed(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, labels=True, size=(64, 48), dist=LENS)
    for path in (root / "labels").rglob("*.png"):
        labels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path), np.where(labels == 2, 200, labels).astype(np.uint8))
    for frame in every_frame(root, size=40, crop=PersonCrop()):
        assert frame.labels is not None
        assert set(frame.labels.unique().tolist()) == {0, 1, 200}


def test_the_crop_comes_from_skeleton_and_camera_alone(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path)
    before = read_capture(root)
    windows = [CaptureDataset(before, [i], crop=PersonCrop()).window(i) for i in items(before)]
    for path in (root / "masks").rglob("*.png"):
        cv2.imwrite(str(path), np.zeros((24, 32), np.uint8))
    after = read_capture(root, trust=Trust(frames=0))
    blind = CaptureDataset(after, items(after), size=16, crop=PersonCrop())
    assert [blind.window(i) for i in items(after)] == windows
    assert (blind[0].image == 0).all()


def test_crop_is_square_and_has_the_margin_in_metres(tmp_path: Path) -> None:
    layout = read_capture(write_tiny_capture(tmp_path, cameras=1, frames=1, size=(400, 400)))
    view = layout.cameras["cam00"]
    joints, usable = np.tile([0.0, 0.0, 0.9], (33, 1)), np.ones(33, bool)
    joints[0, 2] = 1.5
    window = PersonCrop(0.3).window(view, joints, usable)
    # focal 480 at 3 m is 160 px a metre: from 0.3 m below the low joint to 0.3 above the high one
    assert window == Crop(200 - 144, 200 - 96, (192, 192))
    usable[0] = False
    assert PersonCrop(0.3).window(view, joints, usable) == Crop(152, 152, (96, 96))


def test_crop_beyond_the_border_is_black_and_follows_only_what_is_in_view(tmp_path: Path) -> None:
    layout = read_capture(write_tiny_capture(tmp_path, cameras=1, frames=1, size=(400, 400)))
    view = layout.cameras["cam00"]
    joints, usable = np.tile([-1.2, 0.0, 0.9], (33, 1)), np.ones(33, bool)
    joints[1] = [-9.0, 0.0, 0.9]  # far out to the left
    window = PersonCrop(0.3).window(view, joints, usable)
    assert window.size == (96, 96)
    assert window.left < 0
    piece = cut(np.full((400, 400, 3), 9, np.uint8), window)
    assert (piece[:, : -window.left] == 0).all()
    assert (piece[:, -window.left :] == 9).all()
    assert (cut(np.ones((4, 4), np.uint8), Crop(50, 50, (3, 2))) == np.zeros((3, 2))).all()


def test_crop_without_joints_in_front_is_the_whole_picture(tmp_path: Path) -> None:
    layout = read_capture(write_tiny_capture(tmp_path))
    behind = np.tile([0.0, -50.0, 0.9], (33, 1))
    window = PersonCrop().window(layout.cameras["cam00"], behind, np.ones(33, bool))
    assert window == square_window((24, 32)) == Crop(-4, 0, (32, 32))


def test_full_frames_of_uneven_cameras_share_one_size(tmp_path: Path) -> None:
    for frame in every_frame(write_tiny_capture(tmp_path), size=16):
        assert frame.image.shape[-2:] == (16, 16)
        assert torch.allclose(frame.camera.K[:, 0, 0], frame.camera.K[:, 1, 1])
        assert (frame.mask[..., :2, :] == 0).all()  # 4 of 32 rows padded above, halved


def test_millimetres_become_metres_and_it_is_said(tmp_path: Path) -> None:
    metres = every_frame(write_tiny_capture(tmp_path / "m", body_pose=True))
    root = write_tiny_capture(tmp_path / "mm", body_pose=True, unit="mm")
    for a, b in zip(metres, every_frame(root), strict=True):
        assert torch.allclose(a.skeleton, b.skeleton)
        assert torch.allclose(a.camera.t, b.camera.t)
        assert a.body is not None
        assert b.body is not None
        assert torch.allclose(a.body.transl, b.body.transl)
    assert "lengths converted from mm to metres" in read_capture(root).notes


def test_pixel_centres_at_whole_numbers_are_moved(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path)
    before = read_capture(root).cameras["cam00"].K
    edit_json(root / "meta.json", lambda meta: meta.update(pixel_centre=0))
    assert np.allclose(
        read_capture(root).cameras["cam00"].K - before, [[0, 0, 0.5], [0, 0, 0.5], [0] * 3]
    )


def test_frames_pair_by_number_not_by_position(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, frames=4)
    (root / "images/cam01/000001.png").unlink()
    (root / "images/cam00/000002.png").rename(root / "images/cam00/take5_000002.png")
    layout = read_capture(root)
    dataset = CaptureDataset(layout, items(layout))
    assert [f for c, f in dataset.items if c == "cam01"] == [0, 2, 3]
    for i, (_, number) in enumerate(dataset.items):
        expected = torch.from_numpy(skeletons(4)[number]).float()
        assert torch.equal(dataset[i].skeleton[0], expected)
        assert dataset[i].frame_id.item() == number
    assert any("cam01 3 (matched by frame number)" in note for note in layout.notes)


def test_landmark_rows_in_any_order(tmp_path: Path) -> None:
    root, ids = write_tiny_capture(tmp_path, frames=4), np.array([2, 0, 3, 1])
    p = skeletons(4)
    p[3, 15] = np.nan
    write_landmarks(root, p=p[ids], frame_id=ids)
    layout = read_capture(root)
    assert all(np.allclose(layout.landmarks.p[f], p[f]) for f in range(3))
    assert np.allclose(layout.landmarks.p[3][15], p[2, 15])  # frame 2 is nearest, not row 1


def test_missing_joints_stand_in_from_the_nearest_frame(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, frames=4)
    p, conf = skeletons(4), np.ones((4, 33))
    p[1, 15] = np.nan
    p[1, 17] = np.inf
    conf[3, 16] = 0
    conf[2, 18] = -1
    p[:, 21] = np.nan  # never seen
    p[0, 22] = [9, 9, 9]  # metres away from the rest
    write_landmarks(root, p=p, conf=conf, frame_id=np.arange(4))
    layout, truth = read_capture(root), skeletons(4)
    frames = [CaptureDataset(layout, items(layout))[i] for i in range(4)]
    joints = torch.cat([f.skeleton for f in frames])
    seen = torch.cat([f.visibility for f in frames])
    assert torch.isfinite(joints).all()
    for frame, joint in [(1, 15), (1, 17), (3, 16), (2, 18), (0, 21), (0, 22)]:
        assert seen[frame, joint] == 0
    assert seen.sum() == 4 * 33 - 5 - 4
    assert np.allclose(joints[1, 15], truth[0, 15], atol=1e-6)
    assert np.allclose(joints[3, 16], truth[2, 16], atol=1e-6)
    assert np.allclose(joints[0, 22], truth[1, 22], atol=1e-6)
    others = np.delete(truth[3], [16, 21], axis=0)
    assert np.allclose(joints[3, 21], others.mean(0), atol=1e-6)
    assert any("1 joints further than 3 m" in note for note in layout.notes)


def test_nearest_in_time_counts_frame_numbers_not_rows() -> None:
    p = np.arange(4.0)[:, None, None] * np.ones((4, 1, 3))
    valid = np.array([[True], [False], [False], [True]])
    filled = fill_missing(p, valid, np.array([0, 10, 90, 100]))
    assert filled[:, 0, 0].tolist() == [0, 0, 3, 3]
    filled = fill_missing(p, valid, np.array([0, 80, 90, 100]))
    assert filled[:, 0, 0].tolist() == [0, 3, 3, 3]
    assert (fill_missing(p, np.zeros((4, 1), bool), np.arange(4)) == 0).all()


def test_frames_with_too_few_joints_are_dropped_and_counted(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, frames=4)
    p = skeletons(4)
    p[1, 5:] = np.nan
    p[2, [11, 12]] = np.nan
    write_landmarks(root, p=p, frame_id=np.arange(4))
    layout = read_capture(root)
    assert layout.frames == (0, 3)
    assert any("1 of 4 frames dropped, with fewer than 12 joints" in n for n in layout.notes)
    assert any("fewer than 3 of the shoulders and hips: 2" in n for n in layout.notes)
    assert read_capture(root, Checks(min_joints=5, min_hubs=0)).frames == (0, 1, 2, 3)


def test_frames_without_landmarks_or_pose_are_dropped_and_counted(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, frames=4, body_pose=True)
    write_landmarks(root, p=skeletons(4)[:3], frame_id=np.array([1, 2, 3]))
    theta = np.zeros((4, 56, 3))
    theta[2, 0] = np.nan
    np.savez(root / "body_pose.npz", theta=theta, transl=np.zeros((4, 3)), frame_id=np.arange(4))
    layout = read_capture(root)
    assert layout.frames == (1, 3)
    assert any("without a row in landmarks3d.npz: 0" in n for n in layout.notes)
    assert any("without a finite row in body_pose.npz: 2" in n for n in layout.notes)


def test_landmarks_without_pictures_are_noted(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, frames=2)
    write_landmarks(root, p=skeletons(5), frame_id=np.arange(5))
    assert any("3 frames in landmarks3d.npz have no image" in n for n in read_capture(root).notes)


def test_a_frame_out_of_a_cameras_view_is_dropped_for_that_camera(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, frames=4)
    p = skeletons(4)
    p[2] += [4.0, -0.5, 0]  # out of the picture, still in front of both cameras
    write_landmarks(root, p=p, frame_id=np.arange(4))
    layout = read_capture(root)
    assert layout.frames == (0, 1, 3)
    assert any("camera cam00: 1 frames dropped" in note for note in layout.notes)


def test_a_picture_without_labels_counts_as_ignore(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, labels=True)
    (root / "labels/cam00/000000.png").unlink()
    frames = every_frame(root)
    assert frames[0].labels is not None
    assert (frames[0].labels == 255).all()
    assert frames[1].labels is not None
    assert (frames[1].labels < 3).all()
    assert any("1 of 8 images have no labels" in note for note in read_capture(root).notes)


def test_bilevel_and_grey_files_are_read(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, cameras=1, frames=1)
    (root / "masks/cam00/000000.png").write_bytes(png(32, 24, depth=1, kind=0, row=b"\xff" * 4))
    cv2.imwrite(str(root / "images/cam00/000000.png"), np.full((24, 32), 51, np.uint8))
    (frame,) = every_frame(root)
    assert (frame.mask == 1).all()
    assert torch.allclose(frame.image, torch.tensor(0.2))


def png(width: int, height: int, depth: int, kind: int, row: bytes) -> bytes:
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", crc(name + data))

    crc = zlib.crc32
    head = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    palette = chunk(b"PLTE", bytes(range(6))) if kind == 3 else b""
    data = zlib.compress((b"\0" + row) * height)
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + palette
    return start + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_headers_tell_the_size_without_decoding(tmp_path: Path) -> None:
    for suffix in ("png", "jpg"):
        path = tmp_path / f"x.{suffix}"
        cv2.imwrite(str(path), np.zeros((20, 30, 3), np.uint8))
        header = read_header(path)
        assert (header.size, header.depth, header.channels) == ((20, 30), 8, 3)
        assert header.jpeg == (suffix == "jpg")


def test_a_jpeg_without_its_end_is_found_whatever_the_decoder_says(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", noise)[1].tobytes()
    assert not cut_off(data)
    assert not cut_off(data + b"trailing bytes of some camera")
    assert cut_off(data[:-2])
    assert cut_off(data[: len(data) // 2])
    assert cut_off(data[:4])


def test_an_exif_rotation_is_not_applied(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path, cameras=1, frames=1, suffix="jpg")
    path = root / "images/cam00/000000.jpg"
    plain = every_frame(root)[0].image
    # orientation 6 (turn by 90 degrees) in an otherwise empty EXIF block
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    block = b"Exif\0\0" + tiff
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + data[2:])
    assert cv2.imread(str(path)).shape == (32, 24, 3)
    assert torch.equal(every_frame(root)[0].image, plain)


def test_cache_keeps_within_its_bound_and_changes_nothing(tmp_path: Path) -> None:
    layout = read_capture(write_tiny_capture(tmp_path, frames=4))
    cache = PictureCache(3 * 24 * 32 * 4)
    cached = CaptureDataset(layout, items(layout), cache=cache)
    plain = CaptureDataset(layout, items(layout))
    for i in (0, 1, 2, 3, 4, 1, 0, 0):
        assert torch.equal(cached[i].image, plain[i].image)
        assert 0 < cache.currsize <= cache.maxsize
    assert cache.currsize == cache.maxsize
    shutil.rmtree(tmp_path / "images")
    assert cached[0].image.shape == (1, 3, 24, 32)  # the last one used is still held
    with pytest.raises(DataError, match="does not exist"):
        cached[2]


def test_cache_lets_go_of_the_longest_unused() -> None:
    def picture() -> Picture:
        return Picture(np.zeros((3, 2, 2), np.uint8), np.zeros((2, 2), np.uint8), None)

    cache = PictureCache(32)
    cache["a", 0] = picture()
    cache["a", 1] = picture()
    assert cache.get(("a", 0)) is not None
    cache["a", 2] = picture()
    assert cache.get(("a", 1)) is None
    assert cache.get(("a", 0)) is not None
    assert cache.currsize == 32


def test_spans() -> None:
    assert spans([3, 1, 2, 7]) == "1-3, 7"
    assert spans([5]) == "5"


# --- broken captures: each is made by damaging a valid one -------------------------------------


def camera(**changes: object) -> Callable[[Path], None]:
    return lambda root: edit_json(root / "cameras.json", lambda rig: rig["cam01"].update(changes))


def meta(**changes: object) -> Callable[[Path], None]:
    return lambda root: edit_json(root / "meta.json", lambda content: content.update(changes))


def without(key: str) -> Callable[[Path], None]:
    return lambda root: edit_json(root / "cameras.json", lambda rig: rig["cam01"].pop(key))


def landmarks(**arrays: object) -> Callable[[Path], None]:
    defaults = {"p": skeletons(4), "frame_id": np.arange(4)}
    return lambda root: write_landmarks(root, **(defaults | arrays))  # type: ignore[arg-type]


def poses(**arrays: object) -> Callable[[Path], None]:
    held = {"theta": np.zeros((4, 56, 3)), "transl": np.zeros((4, 3)), "frame_id": np.arange(4)}
    return lambda root: np.savez(root / "body_pose.npz", **(held | arrays))  # type: ignore[arg-type]


def write(name: str, data: bytes) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(data)

    return damage


def picture(name: str, array: np.ndarray) -> Callable[[Path], None]:
    return lambda root: cv2.imwrite(str(root / name), array)  # type: ignore[return-value]


def remove(name: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        path = root / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def empty(name: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        for path in (root / name).iterdir():
            path.unlink()

    return damage


def nans(root: Path) -> None:
    landmarks(p=np.full((4, 33, 3), np.nan))(root)


def camera_to_world(root: Path) -> None:
    def invert(rig: dict) -> None:
        R, t = np.array(rig["cam01"]["R"]), np.array(rig["cam01"]["t"])
        rig["cam01"].update(R=R.T.tolist(), t=(-R.T @ t).tolist())

    edit_json(root / "cameras.json", invert)


def turned_round(root: Path) -> None:
    turn = np.diag([-1.0, 1.0, -1.0])

    def turned(rig: dict) -> None:
        R, t = np.array(rig["cam01"]["R"]), np.array(rig["cam01"]["t"])
        rig["cam01"].update(R=(turn @ R).tolist(), t=(turn @ t).tolist())

    edit_json(root / "cameras.json", turned)


def cmyk(root: Path) -> None:
    """A JPEG of four channels."""
    (root / "images/cam01/000000.png").unlink()
    Image.new("CMYK", (32, 24)).save(root / "images/cam01/000000.jpg")


def pickled(root: Path) -> None:
    np.savez(root / "landmarks3d.npz", p=np.array([{"a": 1}], dtype=object), frame_id=np.arange(4))


def smpl_poses_of_free_body(root: Path) -> None:
    meta(body="free")(root)
    poses(theta=np.zeros((4, 24, 3)))(root)


def blank_masks(root: Path) -> None:
    for path in (root / "masks").rglob("*.png"):
        cv2.imwrite(str(path), np.zeros((24, 32), np.uint8))


STRETCHED = np.diag([1.0, 1.1, 1.0])
BAD_INDEX = {
    "no cameras.json": (remove("cameras.json"), "cameras.json does not exist"),
    "broken json": (write("cameras.json", b'{"cam00": '), "cameras.json is not valid JSON.*line 1"),
    "binary json": (write("cameras.json", b"\xff\xfe\0"), "cameras.json is not valid JSON"),
    "json list": (write("cameras.json", b"[]"), "must hold a JSON object, found list"),
    "no cameras": (write("cameras.json", b"{}"), "lists no camera"),
    "camera not an object": (write("cameras.json", b'{"cam00": 3}'), "cam00: expected an object"),
    "camera without pictures": (
        remove("images/cam01"),
        r"lists the camera cam01, but .*images/cam01 does not exist; there are cam00",
    ),
    "pictures without camera": (
        write("images/cam07/000000.png", b""),
        "has the camera cam07, which .*cameras.json does not list; it lists cam00, cam01",
    ),
    "no images": (remove("images"), "images does not exist"),
    "zero frames": (empty("images/cam00"), "images/cam00 holds no frames"),
    "K missing": (without("K"), "camera cam01: expected an object with K, R, t"),
    "K shape": (camera(K=[1, 2, 3]), r"'K' must hold finite numbers of shape \(3, 3\)"),
    "K ragged": (camera(K=[[1], [2, 3]]), r"'K' must hold finite numbers of shape \(3, 3\)"),
    "K focal": (
        camera(K=[[-30, 0, 16], [0, 30, 12], [0, 0, 1]]),
        "camera cam01: the focal lengths in K must be above 0, found -30 and 30",
    ),
    "K transposed": (camera(K=[[30, 0, 0], [0, 30, 0], [16, 12, 1]]), "K must be .*found"),
    "R sheared": (camera(R=STRETCHED.tolist()), "cam01: R is not a rotation.*differs .* by 0.21"),
    "R mirrored": (camera(R=np.diag([1, 1, -1]).tolist()), "R mirrors"),
    "R NaN": (camera(R=np.full((3, 3), np.nan).tolist()), "'R' must hold finite numbers"),
    "t length": (camera(t=[1, 2]), r"'t' must hold finite numbers of shape \(3,\)"),
    "dist length": (camera(dist=[0.1, 0.2, 0.3]), "dist must hold 4, 5 or 8 finite numbers"),
    "dist text": (camera(dist="none"), "dist must hold 4, 5 or 8 finite numbers"),
    "size fraction": (camera(size=[32.5, 24]), r"size must be \[width, height\] in pixels"),
    "size swapped": (camera(size=[24, 32]), "000000.png is 32x24 pixels.*cameras.json has 24x32"),
    "camera to world": (camera_to_world, "cam01: no frame has 4 joints.*R and t map world to"),
    "camera turned round": (
        turned_round,
        "cam01: 100% of the joints lie behind it; R and t must map world to camera",
    ),
    "looks elsewhere": (
        camera(K=[[30, 0, 900], [0, 30, 12], [0, 0, 1]]),
        "camera cam01: no frame has 4 joints inside the image",
    ),
    "no meta.json": (remove("meta.json"), "meta.json does not exist"),
    "no unit": (meta(unit=None), "'unit' is None; expected one of m, cm, mm"),
    "wrong unit": (meta(unit="mm"), "cameras stand 0.003.* m from the person.*check 'unit'"),
    "skeleton": (meta(skeleton="coco"), "'skeleton' is 'coco'; expected one of mediapipe33"),
    "fps": (meta(fps=0), "'fps' is 0; expected a number above 0"),
    "splits": (meta(splits=[1]), "'splits' must be an object"),
    "label names": (meta(label_names="a"), "'label_names' must list"),
    "no landmarks": (remove("landmarks3d.npz"), "landmarks3d.npz does not exist"),
    "landmarks not npz": (write("landmarks3d.npz", b"hello"), "landmarks3d.npz"),
    "landmarks cut off": (
        write("landmarks3d.npz", b"PK\x03\x04" + bytes(40)),
        "landmarks3d.npz is not a valid npz file",
    ),
    "landmarks pickled": (pickled, "asks for pickled Python objects.*nothing was run"),
    "landmarks shape": (
        landmarks(p=np.zeros((4, 25, 3))),
        r"'p' must have shape \(any, 33, 3\), found \(4, 25, 3\)",
    ),
    "landmarks text": (
        landmarks(p=np.full((4, 33, 3), "a")),
        "'p' must hold numbers, found <U1",
    ),
    "conf shape": (landmarks(conf=np.ones((4, 3))), r"'conf' must have shape \(4, 33\)"),
    "frame_id length": (landmarks(frame_id=np.arange(3)), r"'frame_id' must have shape \(4\)"),
    "frame_id twice": (landmarks(frame_id=np.array([0, 1, 1, 2])), "frame_id 1 appears more than"),
    "frame_id fraction": (landmarks(frame_id=np.arange(4) + 0.5), "must hold whole numbers"),
    "no frame_id": (
        lambda root: np.savez(root / "landmarks3d.npz", p=skeletons(4)),
        "has no array 'frame_id'",
    ),
    "joints all NaN": (nans, "has no usable frame: 4 with fewer than 12 joints"),
    "no common frame": (
        landmarks(frame_id=np.arange(100, 104)),
        "no usable frame: 4 without a row in landmarks3d.npz",
    ),
    "theta of another body": (
        smpl_poses_of_free_body,
        r"'theta' must have shape \(any, 56, 3\), found \(4, 24, 3\)",
    ),
    "unknown body": (meta(body="smplh"), "'body' is 'smplh'; expected one of free, smpl, smplx"),
    "masks all empty": (
        blank_masks,
        "masks/cam00/000000.png shows no person, nor does any of the 6 masks compared",
    ),
    "mask 16 bit": (
        picture("masks/cam00/000001.png", np.zeros((24, 32), np.uint16)),
        "000001.png has 16 bits a channel; expected 8",
    ),
    "frame of a date": (
        write("images/cam00/20240131120000123456.png", b""),
        "20240131120000123456.png has no frame number up to .*frames 0, 1, 2 … equally",
    ),
    "theta shape": (poses(theta=np.zeros((4, 168))), r"'theta' must have shape \(any, any, 3\)"),
    "transl shape": (poses(transl=np.zeros((3, 3))), r"'transl' must have shape \(4, 3\)"),
    "no mask": (
        remove("masks/cam01/000002.png"),
        r"masks/cam01/000002.png does not exist; every image needs a mask, and 1 of the 4",
    ),
    "no masks": (remove("masks"), "masks/cam00/000000.png does not exist"),
    "mask size": (
        picture("masks/cam01/000001.png", np.zeros((12, 16), np.uint8)),
        r"masks/cam01/000001.png is 16x12 pixels .*the image .*images/cam01/000001.png has",
    ),
    "image size": (
        picture("images/cam01/000001.png", np.zeros((12, 16, 3), np.uint8)),
        r"images/cam01/000001.png is 16x12 pixels .*cameras.json has 32x24",
    ),
    "image not an image": (write("images/cam00/000001.png", b"text"), "not a valid PNG or JPEG"),
    "image empty": (write("images/cam00/000001.png", b""), "not a valid PNG or JPEG"),
    "image cut in header": (
        write("images/cam00/000001.png", b"\x89PNG\r\n\x1a\n\0\0"),
        "not a valid PNG or JPEG",
    ),
    "jpeg without a frame": (
        write("images/cam00/000001.png", b"\xff\xd8\xff\xda\0\0"),
        "not a valid PNG or JPEG",
    ),
    "image 16 bit": (
        picture("images/cam00/000001.png", np.zeros((24, 32, 3), np.uint16)),
        "000001.png has 16 bits a channel; expected 8",
    ),
    "image CMYK": (cmyk, "000000.jpg is a CMYK JPEG"),
    "mask palette": (
        write("masks/cam00/000001.png", png(32, 24, 8, 3, bytes(32))),
        "masks/cam00/000001.png is a palette PNG",
    ),
    "frame twice": (
        write("images/cam00/0001.png", b""),
        "holds frame 1 twice, as 000001.png and 0001.png",
    ),
    "frame without number": (write("images/cam00/first.png", b""), "has no frame number"),
    "labels colour": (
        write("labels/cam00/000001.png", png(32, 24, 8, 2, bytes(96))),
        "labels/cam00/000001.png is a palette PNG or has colours; expected 8-bit grey",
    ),
}


@pytest.mark.parametrize("name", BAD_INDEX)
def test_a_broken_capture_is_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    damage, message = BAD_INDEX[name]
    root = write_tiny_capture(tmp_path)
    read_capture(root)
    damage(root)
    with pytest.raises(DataError, match=message) as caught:
        read_capture(root)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def truncate(name: str, keep: float) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        data = (root / name).read_bytes()
        (root / name).write_bytes(data[: int(len(data) * keep)])

    return damage


BAD_PICTURE = {
    "jpg half": (truncate("images/cam00/000001.jpg", 0.7), "images/cam00/000001.jpg is damaged"),
    "jpg end": (truncate("images/cam00/000001.jpg", 0.995), "images/cam00/000001.jpg is damaged"),
    "png half": (truncate("masks/cam00/000001.png", 0.6), "masks/cam00/000001.png is damaged"),
    "gone": (remove("images/cam00/000001.jpg"), "images/cam00/000001.jpg does not exist"),
    "mask of 0 and 1": (
        picture("masks/cam00/000001.png", np.ones((24, 32), np.uint8)),
        "masks/cam00/000001.png holds 0 and 1; expected alpha from 0 to 255",
    ),
    "label too high": (
        picture("labels/cam00/000001.png", np.full((24, 32), 3, np.uint8)),
        "labels/cam00/000001.png holds the label 3; meta.json names 3 labels",
    ),
}


@pytest.mark.parametrize("name", BAD_PICTURE)
def test_a_broken_picture_is_refused_when_it_is_read(tmp_path: Path, name: str) -> None:
    damage, message = BAD_PICTURE[name]
    names = {"label_names": ["background", "upper", "lower"]}
    root = write_tiny_capture(tmp_path, suffix="jpg", labels=True, meta=names)
    layout = read_capture(root)
    dataset = CaptureDataset(layout, items(layout))
    damage(root)
    assert dataset[0].frame_id == 0
    with pytest.raises(DataError, match=message) as caught:
        dataset[1]
    assert "\n" not in str(caught.value)


def test_an_empty_mask_is_noted(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path)
    cv2.imwrite(str(root / "masks/cam00/000001.png"), np.zeros((24, 32), np.uint8))
    (note,) = read_capture(root).notes
    assert note.startswith("camera cam00: the mask is empty at frames 1 of 4 compared")


def test_a_skewed_K_is_kept_and_undistorted_with_its_skew(tmp_path: Path) -> None:
    """A dot drawn where lens and skew put a point is found where the pinhole camera puts it."""
    root = write_tiny_capture(tmp_path, size=(200, 160), cameras=1)
    content = json.loads((root / "cameras.json").read_text())["cam00"]
    K = np.array(content["K"])
    K[0, 1] = 40
    k1 = -0.15
    edit_json(
        root / "cameras.json",
        lambda rig: rig["cam00"].update(K=K.tolist(), dist=[k1, 0, 0, 0, 0]),
    )
    x, y = 0.2, -0.3
    bend = 1 + k1 * (x * x + y * y)
    u, v = (K @ [x * bend, y * bend, 1])[:2]
    rows, columns = np.mgrid[:160, :200] + 0.5
    dot = 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 8)
    cv2.imwrite(str(root / "images/cam00/000000.png"), np.repeat(dot[..., None], 3, -1))
    cv2.imwrite(str(root / "masks/cam00/000000.png"), np.full((160, 200), 255, np.uint8))
    frame = CaptureDataset(read_capture(root), [("cam00", 0)])[0]
    np.testing.assert_allclose(frame.camera.K[0], K, atol=1e-4)
    weight = frame.image[0, 0].double().numpy()
    found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    np.testing.assert_allclose(found, (K @ [x, y, 1])[:2], atol=0.15)


def test_arrays_that_would_unpack_to_too_much_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write_tiny_capture(tmp_path)
    monkeypatch.setattr("gsgan.utils.pickles.LARGEST_ARRAY", 1000)
    with pytest.raises(DataError, match=r"landmarks3d.npz is not a valid npz file .p would"):
        read_capture(root)


def test_frame_numbers_end() -> None:
    assert last_number("frame_0000000000000012") == 12
    assert last_number("1000000000") == 10**9
    assert last_number("1000000001") is None
    assert last_number("9" * 5000) is None


def test_wrong_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere does not exist; expected the folder"):
        read_capture(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="file is a file, not a folder"):
        read_capture(tmp_path / "file")


@pytest.mark.parametrize("size", [0, -4, 1.5, "big"])
def test_bad_sizes(tmp_path: Path, size: object) -> None:
    layout = read_capture(write_tiny_capture(tmp_path))
    with pytest.raises(ConfigError, match=r"data.size must be a whole number"):
        CaptureDataset(layout, items(layout), size=size)  # type: ignore[arg-type]


def test_bad_margin() -> None:
    with pytest.raises(ConfigError, match=r"data.crop.margin must be a number above 0"):
        PersonCrop(0)


def test_loose_calibration_habits_are_accepted(tmp_path: Path) -> None:
    """A column for t and no dist at all mean what they look like."""
    root = write_tiny_capture(tmp_path)
    t = ring_camera(0.0, (32, 24))["t"]
    edit_json(root / "cameras.json", lambda rig: rig["cam00"].update(t=[[x] for x in t]))
    edit_json(root / "cameras.json", lambda rig: rig["cam00"].pop("dist"))
    layout = read_capture(root)
    assert np.allclose(layout.cameras["cam00"].t, t)
    assert not layout.cameras["cam00"].distorted


# --- the real capture ---------------------------------------------------------------------------


def test_real_capture_is_read_whole(real_capture: Path) -> None:
    layout = read_capture(real_capture)
    assert layout.camera_names == ("cam01", "cam02", "cam03", "cam04")
    assert layout.frames == tuple(range(70))
    assert all(len(files) == 70 for files in layout.images.values())
    assert layout.notes == ()


def test_real_joints_lie_on_the_person_in_the_crop(real_capture: Path) -> None:
    layout = read_capture(real_capture)
    chosen = [(c, f) for c in layout.cameras for f in range(0, 70, 10)]
    dataset = CaptureDataset(layout, chosen, size=128, crop=PersonCrop())
    hits, total = 0, 0
    for i, item in enumerate(chosen):
        frame = dataset[i]
        pixels, depth = frame.camera.project(frame.skeleton)
        assert (depth > 0.5).all()
        assert ((pixels > 0) & (pixels < 128)).all()
        u, v = pixels[0].long().unbind(-1)
        near = torch.nn.functional.max_pool2d(frame.mask, 3, 1, 1)[0, 0]  # landmarks: ~11 mm noise
        hits, total = hits + int((near[v, u] > 0.5).sum()), total + len(u)
        mask = cv2.imread(str(layout.mask_path(*item)), cv2.IMREAD_GRAYSCALE)
        kept = cut(mask, dataset.window(item)).sum() / mask.sum()
        assert kept > 0.999, f"{item}: the crop cuts off {1 - kept:.2%} of the person"
    assert hits / total > 0.9
