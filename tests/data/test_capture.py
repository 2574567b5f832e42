"""The reader: what a `Frame` holds, and which frames it takes."""

import shutil
import struct

import cv2
import numpy as np
import pytest
import torch
from capture_frames import every_frame, items, png
from make import (
    edit_json,
    ring_camera,
    skeletons,
    write_landmarks,
    write_tiny_capture,
)

from gsgan.data.dataset import CaptureDataset, ImageCache
from gsgan.data.formats.capture import CaptureReader, read_capture
from gsgan.data.formats.consistency import Consistency
from gsgan.data.validation import Thresholds
from gsgan.scene import cat
from gsgan.utils.errors import DataError
from gsgan.utils.image_files import cut_off


def test_frame_holds_what_its_docstring_says(tmp_path):
    root = write_tiny_capture(
        tmp_path, labels=True, body_pose=True, first_frame=7
    )
    frames = every_frame(root)
    assert len(frames) == 8
    frame = cat(frames)
    assert frame.image.shape == (8, 3, 24, 32)
    assert frame.image.dtype == torch.float32
    assert frame.mask.shape == (8, 1, 24, 32)
    assert frame.mask.amax() == 1
    assert frame.labels.shape == (8, 24, 32)
    assert frame.labels.dtype == torch.int64
    assert set(frame.labels.unique().tolist()) == {0, 1, 2}
    assert frame.frame_id.tolist() == [7, 8, 9, 10] * 2
    assert frame.camera_index.tolist() == [0] * 4 + [1] * 4
    assert frame.camera.dist is None
    assert frame.body.theta.shape == (8, 56, 3)
    assert torch.allclose(frame.body.theta[:, 0, 2], 0.1 * frame.frame_id)
    expected = torch.from_numpy(skeletons(4)).float()
    assert torch.allclose(frame.skeleton, torch.cat([expected, expected]))
    assert (frame.visibility == 1).all()


def test_colours_are_rgb_and_the_background_is_black(tmp_path):
    frame = every_frame(write_tiny_capture(tmp_path))[0]
    person = (frame.mask[0, 0] == 1) & (frame.image[0, 0] > 0.5)
    assert person.sum() > 10
    red, green, blue = frame.image[0][:, person]
    # drawn as RGB (200, 40.., 60)
    assert torch.allclose(red, torch.full_like(red, 200 / 255))
    assert torch.allclose(blue, torch.full_like(blue, 60 / 255))
    assert (green <= 200 / 255).all()
    assert (
        frame.image[0][:, frame.mask[0, 0] == 0] == 0
    ).all()  # the wall was grey


def test_soft_masks_mix_with_black_once(tmp_path):
    root = write_tiny_capture(tmp_path, cameras=1, frames=1)
    cv2.imwrite(
        str(root / "images/cam00/000000.png"),
        np.full((24, 32, 3), 100, np.uint8),
    )
    cv2.imwrite(
        str(root / "masks/cam00/000000.png"), np.full((24, 32), 51, np.uint8)
    )
    consistency = Consistency(
        frames=0
    )  # no pixel of such a mask counts as the person
    assert torch.allclose(
        every_frame(root, consistency)[0].image, torch.tensor(20 / 255)
    )
    edit_json(root / "meta.json", lambda meta: meta.update(background="black"))
    assert torch.allclose(
        every_frame(root, consistency)[0].image, torch.tensor(100 / 255)
    )


def test_millimetres_become_metres_and_it_is_said(tmp_path):
    metres = every_frame(write_tiny_capture(tmp_path / "m", body_pose=True))
    root = write_tiny_capture(tmp_path / "mm", body_pose=True, unit="mm")
    for a, b in zip(metres, every_frame(root), strict=True):
        assert torch.allclose(a.skeleton, b.skeleton)
        assert torch.allclose(a.camera.t, b.camera.t)
        assert torch.allclose(a.body.transl, b.body.transl)
    assert "lengths converted from mm to metres" in read_capture(root).notes


def test_frames_pair_by_number_not_by_position(tmp_path):
    root = write_tiny_capture(tmp_path, frames=4)
    (root / "images/cam01/000001.png").unlink()
    (root / "images/cam00/000002.png").rename(
        root / "images/cam00/take5_000002.png"
    )
    layout = read_capture(root)
    dataset = CaptureDataset(layout, items(layout))
    assert [f for c, f in dataset.items if c == "cam01"] == [0, 2, 3]
    for i, (_, number) in enumerate(dataset.items):
        expected = torch.from_numpy(skeletons(4)[number]).float()
        assert torch.equal(dataset[i].skeleton[0], expected)
        assert dataset[i].frame_id.item() == number


def test_a_band_round_the_outline_is_left_out_of_the_loss(tmp_path):
    layout = CaptureReader(ignore_band=3)(
        write_tiny_capture(tmp_path), Thresholds()
    )
    frame = CaptureDataset(layout, items(layout))[0]
    band = frame.ignored[0, 0] > 0
    person = frame.mask[0, 0] > 0.5
    assert band.any()
    assert (person & ~band).any()
    edge = (person[:, 1:] != person[:, :-1]).nonzero()
    assert band[edge[:, 0], edge[:, 1]].all()


def test_missing_joints_stand_in_from_the_nearest_frame(tmp_path):
    """Not from the nearest row: these may be in any order."""
    root, ids = write_tiny_capture(tmp_path, frames=4), np.array([2, 0, 3, 1])
    p, conf = skeletons(4), np.ones((4, 33))
    p[1, 15] = np.nan
    p[1, 17] = np.inf
    conf[3, 16] = 0
    conf[2, 18] = -1
    p[:, 21] = np.nan  # never seen
    p[0, 22] = [9, 9, 9]  # metres away from the rest
    write_landmarks(root, p=p[ids], conf=conf[ids], frame_id=ids)
    layout, truth = read_capture(root), skeletons(4)
    frames = [CaptureDataset(layout, items(layout))[i] for i in range(4)]
    joints = torch.cat([f.skeleton for f in frames])
    seen = torch.cat([f.visibility for f in frames])
    assert torch.isfinite(joints).all()
    for frame, joint in [(1, 15), (1, 17), (3, 16), (2, 18), (0, 21), (0, 22)]:
        assert seen[frame, joint] == 0
    assert seen.sum() == 4 * 33 - 5 - 4
    assert np.allclose(joints[seen == 1], truth[seen == 1], atol=1e-6)
    assert np.allclose(joints[1, 15], truth[0, 15], atol=1e-6)
    assert np.allclose(joints[3, 16], truth[2, 16], atol=1e-6)
    assert np.allclose(joints[0, 22], truth[1, 22], atol=1e-6)
    others = np.delete(truth[3], [16, 21], axis=0)
    assert np.allclose(joints[3, 21], others.mean(0), atol=1e-6)
    assert any("1 joints further than 3 m" in note for note in layout.notes)


def test_frames_with_too_few_joints_are_dropped_and_counted(tmp_path):
    root = write_tiny_capture(tmp_path, frames=4)
    p = skeletons(4)
    p[1, 5:] = np.nan
    p[2, [11, 12]] = np.nan
    write_landmarks(root, p=p, frame_id=np.arange(4))
    layout = read_capture(root)
    assert layout.frames == (0, 3)
    assert any(
        "1 of 4 frames dropped, with fewer than 12 joints" in n
        for n in layout.notes
    )
    assert any(
        "fewer than 3 of the shoulders and hips: 2" in n for n in layout.notes
    )
    assert read_capture(root, Thresholds(min_joints=5, min_hubs=0)).frames == (
        0,
        1,
        2,
        3,
    )


def test_an_upper_body_without_hips_is_read(tmp_path):
    """Hips are estimated below the shoulders, marked as unseen, and do not nod with the head."""
    root = write_tiny_capture(tmp_path, frames=4)
    truth = skeletons(4)
    p = truth.copy()
    p[:, 23:] = np.nan
    p[1, :11, 1] -= 0.05  # a nod
    write_landmarks(root, p=p, frame_id=np.arange(4))
    layout = read_capture(root)
    assert layout.frames == (0, 1, 2, 3)
    hips = np.stack([layout.landmarks.p[f][[23, 24]] for f in range(4)])
    np.testing.assert_allclose(
        hips, truth[:, [23, 24]], atol=0.07
    )  # size by the arms
    down = hips.mean(1) - truth[:, [11, 12]].mean(1)
    np.testing.assert_allclose(down, down[:1].repeat(4, axis=0), atol=1e-9)
    assert (
        np.stack([layout.landmarks.visibility[f][23:] for f in range(4)]) == 0
    ).all()
    p[2] = truth[2]  # one frame shows them: its trunk is the others'
    write_landmarks(root, p=p, frame_id=np.arange(4))
    landmarks = read_capture(root).landmarks
    np.testing.assert_allclose(
        landmarks.p[0][[23, 24]], truth[0, [23, 24]], atol=0.02
    )
    np.testing.assert_allclose(
        landmarks.p[0][[23, 24], 2], truth[0, [23, 24], 2]
    )


def test_a_frame_out_of_a_cameras_view_is_dropped_for_that_camera(tmp_path):
    root = write_tiny_capture(tmp_path, frames=4)
    p = skeletons(4)
    p[2] += [4.0, -0.5, 0]  # out of the picture, still in front of both cameras
    write_landmarks(root, p=p, frame_id=np.arange(4))
    layout = read_capture(root)
    assert layout.frames == (0, 1, 3)
    assert any(
        "camera cam00: 1 frames dropped" in note for note in layout.notes
    )


def test_a_picture_without_labels_counts_as_ignore(tmp_path):
    root = write_tiny_capture(tmp_path, labels=True)
    (root / "labels/cam00/000000.png").unlink()
    frames = every_frame(root)
    assert (frames[0].labels == 255).all()
    assert (frames[1].labels < 3).all()


def test_bilevel_and_grey_files_are_read(tmp_path):
    root = write_tiny_capture(tmp_path, cameras=1, frames=1)
    (root / "masks/cam00/000000.png").write_bytes(
        png(32, 24, depth=1, kind=0, row=b"\xff" * 4)
    )
    cv2.imwrite(
        str(root / "images/cam00/000000.png"), np.full((24, 32), 51, np.uint8)
    )
    (frame,) = every_frame(root)
    assert (frame.mask == 1).all()
    assert torch.allclose(frame.image, torch.tensor(0.2))


def test_a_jpeg_without_its_end_is_found_whatever_the_decoder_says(tmp_path):
    noise = np.random.default_rng(0).integers(
        0, 255, (32, 32, 3), dtype=np.uint8
    )
    data = cv2.imencode(".jpg", noise)[1].tobytes()
    assert not cut_off(data)
    assert not cut_off(data + b"trailing bytes of some camera")
    assert cut_off(data[:-2])
    assert cut_off(data[: len(data) // 2])
    assert cut_off(data[:4])


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_an_exif_rotation_is_refused(tmp_path, orientation):
    """Half of the programs that make masks, landmarks and calibrations undo it, half do not."""
    root = write_tiny_capture(tmp_path, cameras=1, frames=1, suffix="jpg")
    path = root / "images/cam00/000000.jpg"
    plain = every_frame(root)[0].image
    # the orientation in an otherwise empty EXIF block
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0%c\0\0\0\0\0\0"
    tiff = tiff % orientation
    block = b"Exif\0\0" + tiff
    data = path.read_bytes()
    path.write_bytes(
        data[:2]
        + b"\xff\xe1"
        + struct.pack(">H", len(block) + 2)
        + block
        + data[2:]
    )
    if orientation == 1:
        assert torch.equal(every_frame(root)[0].image, plain)
        return
    with pytest.raises(DataError, match=f"EXIF orientation {orientation}"):
        every_frame(root)


def test_cache_keeps_within_its_bound_and_changes_nothing(tmp_path):
    layout = read_capture(write_tiny_capture(tmp_path, frames=4))
    cache = ImageCache(3 * 24 * 32 * 4)
    cached = CaptureDataset(layout, items(layout), cache=cache)
    plain = CaptureDataset(layout, items(layout))
    for i in (0, 1, 2, 3, 4, 1, 0, 0):
        assert torch.equal(cached[i].image, plain[i].image)
        assert 0 < cache.currsize <= cache.maxsize
    assert cache.currsize == cache.maxsize
    shutil.rmtree(tmp_path / "images")
    assert cached[0].image.shape == (
        1,
        3,
        24,
        32,
    )  # the last one used is still held
    with pytest.raises(DataError, match="does not exist"):
        cached[2]


def test_loose_calibration_habits_are_accepted(tmp_path):
    """A column for t and no dist at all mean what they look like."""
    root = write_tiny_capture(tmp_path)
    t = ring_camera(0.0, (32, 24))["t"]
    edit_json(
        root / "cameras.json",
        lambda rig: rig["cam00"].update(t=[[x] for x in t]),
    )
    edit_json(root / "cameras.json", lambda rig: rig["cam00"].pop("dist"))
    layout = read_capture(root)
    assert np.allclose(layout.cameras["cam00"].t, t)
    assert not layout.cameras["cam00"].distorted
