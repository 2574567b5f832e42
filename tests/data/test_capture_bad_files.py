"""One sentence for each way a capture can be broken."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_frames import items, png
from make import edit_json, skeletons, write_landmarks, write_tiny_capture
from PIL import Image

from gsgan.data.dataset import CaptureDataset
from gsgan.data.files import last_number
from gsgan.data.formats.capture import read_capture
from gsgan.utils.errors import DataError


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
        r"'theta' must have shape \(4, 56, 3\), found \(4, 24, 3\)",
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
    "theta shape": (poses(theta=np.zeros((4, 168))), r"'theta' must have shape \(4, any, 3\)"),
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
