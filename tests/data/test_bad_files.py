"""Damaged files of every format: one sentence that names the file, one case for each message."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from capture_frames import items, png
from make import (
    edit_json,
    edit_npz,
    skeletons,
    write_face,
    write_hands,
    write_landmarks,
    write_tiny_capture,
)
from PIL import Image
from writers.common import write_object
from writers.easymocap import write_easymocap
from writers.smpl import write_smpl
from writers.smplx_rig import smplx_once, smplx_subject
from writers.thuman4 import write_thuman4
from writers.zju import write_original

from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.capture import read_capture
from gsgan.data.formats.easymocap import EasymocapReader
from gsgan.data.formats.thuman4 import Thuman4Reader
from gsgan.data.formats.zju import ZjuReader
from gsgan.data.layout import Layout
from gsgan.data.validation import Thresholds
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.frame_files import last_number

pytestmark = pytest.mark.usefixtures("model_once")
Damage = Callable[[Path], object]
# What the message must name, as a pattern, and the damage.
Case = tuple[str, Damage]
NEVER = Path("/tmp/never")


# -- damages of any folder


def write(name: str, data: bytes) -> Damage:
    def damage(root: Path) -> None:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(data)

    return damage


def remove(*names: str) -> Damage:
    def damage(root: Path) -> None:
        for path in (root / name for name in names):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def empty(name: str) -> Damage:
    return lambda root: [path.unlink() for path in (root / name).iterdir()]


def cut(name: str, keep: float) -> Damage:
    def damage(root: Path) -> None:
        data = (root / name).read_bytes()
        (root / name).write_bytes(data[: int(len(data) * keep)])

    return damage


def image(pattern: str, array: np.ndarray) -> Damage:
    return lambda root: [
        cv2.imwrite(str(path), array) for path in sorted(root.glob(pattern))
    ]


def replaced(name: str, old: str, new: str) -> Damage:
    return lambda root: (root / name).write_text(
        (root / name).read_text().replace(old, new)
    )


def edited(name: str, change: Callable[[Any], object]) -> Damage:
    return lambda root: edit_json(root / name, change)


def arrays(name: str, change: Callable[[dict[str, Any]], object]) -> Damage:
    """Changes the arrays of an npz file."""
    return lambda root: edit_npz(root / name, change)


def objects(pattern: str, change: Callable[[Any], object]) -> Damage:
    """Changes the pickled objects of npy files."""

    def damage(root: Path) -> None:
        for path in root.glob(pattern):
            content = np.load(path, allow_pickle=True).item()
            change(content)
            write_object(path, content)

    return damage


class Evil:
    def __reduce__(self) -> Any:
        return os.system, (f"touch {NEVER}",)


# -- the bring-your-own layout


def camera(**changes: object) -> Damage:
    return edited("cameras.json", lambda rig: rig["cam01"].update(changes))


def meta(**changes: object) -> Damage:
    return edited("meta.json", lambda content: content.update(changes))


def landmarks(**changed: object) -> Damage:
    defaults = {"p": skeletons(4), "frame_id": np.arange(4)}
    return lambda root: write_landmarks(root, **(defaults | changed))


def poses(**changed: object) -> Damage:
    held = {
        "theta": np.zeros((4, 56, 3)),
        "transl": np.zeros((4, 3)),
        "frame_id": np.arange(4),
    }
    return lambda root: np.savez(root / "body_pose.npz", **(held | changed))


def hands(**changed: object) -> Damage:
    return lambda root: write_hands(root, 4, **changed)


def face(**changed: object) -> Damage:
    return lambda root: write_face(root, 4, **changed)


def turned_round(rig: dict) -> None:
    turn = np.diag([-1.0, 1.0, -1.0])
    R, t = np.array(rig["cam01"]["R"]), np.array(rig["cam01"]["t"])
    rig["cam01"].update(R=(turn @ R).tolist(), t=(turn @ t).tolist())


def cmyk(root: Path) -> None:
    (root / "images/cam01/000000.png").unlink()
    Image.new("CMYK", (32, 24)).save(root / "images/cam01/000000.jpg")


GREY = np.zeros((24, 32), np.uint8)
CAPTURE: list[Case] = [
    (r"cameras\.json", remove("cameras.json")),
    (r"cameras\.json.*line 1", write("cameras.json", b'{"cam00": ')),
    (r"cameras\.json.*list", write("cameras.json", b"[]")),
    (r"cameras\.json", write("cameras.json", b"{}")),
    ("cam00.*K, R, t", write("cameras.json", b'{"cam00": 3}')),
    ("images/cam01.*cam00", remove("images/cam01")),
    ("cam07.*cam00, cam01", write("images/cam07/000000.png", b"")),
    ("images", remove("images")),
    ("images/cam00", empty("images/cam00")),
    (r"cam01.*'K'.*\(3, 3\)", camera(K=[[1], [2, 3]])),
    ("cam01.*K ", camera(K=[[30, 0, 0], [0, 30, 0], [16, 12, 1]])),
    ("cam01.*-30", camera(K=[[-30, 0, 16], [0, 30, 12], [0, 0, 1]])),
    (r"cam01.*R .*0\.21", camera(R=np.diag([1.0, 1.1, 1.0]).tolist())),
    ("cam01.*R mirror", camera(R=np.diag([1, 1, -1]).tolist())),
    ("cam01.*dist", camera(dist=[0.1, 0.2, 0.3])),
    (r"cam01.*size.*32\.5", camera(size=[32.5, 24])),
    (r"000000\.png.*32x24.*24x32", camera(size=[24, 32])),
    ("cam01.*100%", edited("cameras.json", turned_round)),
    ("cam01.* 4 joints", camera(K=[[30, 0, 900], [0, 30, 12], [0, 0, 1]])),
    (r"meta\.json", remove("meta.json")),
    ("'unit'.*None.*m, cm, mm", meta(unit=None)),
    (r"0\.003.* m .*'unit'", meta(unit="mm")),
    ("'fps'.*0", meta(fps=0)),
    ("'splits'", meta(splits=[1])),
    ("'test_camera'.*train_cameras", meta(splits={"test_camera": ["cam01"]})),
    ("cam01.*'distortion'.*'dist'", camera(distortion=[0.1, 0, 0, 0])),
    ("'label_names'", meta(label_names="a")),
    (r"landmarks3d\.npz", write("landmarks3d.npz", b"PK\x03\x04" + bytes(40))),
    (r"landmarks3d\.npz.*nothing was run", landmarks(p=np.array([[Evil()]]))),
    (r"'p'.*\(any, 33, 3\)", landmarks(p=np.zeros((4, 25, 3)))),
    ("'p'.*<U1", landmarks(p=np.full((4, 33, 3), "a"))),
    ("frame_id 1 ", landmarks(frame_id=np.array([0, 1, 1, 2]))),
    ("'frame_id'", landmarks(frame_id=np.arange(4) + 0.5)),
    ("frame_id .*time", landmarks(frame_id=np.arange(4) + 1_700_000_000_123)),
    (
        "'frame_id'",
        lambda root: np.savez(root / "landmarks3d.npz", p=skeletons(4)),
    ),
    (" 4 .* 12 joints", landmarks(p=np.full((4, 33, 3), np.nan))),
    (" 4 .*landmarks3d", landmarks(frame_id=np.arange(100, 104))),
    (r"hands3d\.npz.*'p'.*\(any, 42, 3\)", hands(p=np.zeros((4, 21, 3)))),
    (r"hands3d\.npz.*'conf'.*\(4, 42\)", hands(conf=np.ones((4, 33)))),
    (r"hands3d\.npz.*frame_id 0 ", hands(frame_id=np.zeros(4))),
    (r"face3d\.npz.*'p'.*\(any, 30, 3\)", face(p=np.zeros((4, 468, 3)))),
    ("'names'.*mouth_outer_0", face(names=np.array(["lip"] * 30))),
    (
        "'names' has the landmarks in another order",
        landmarks(names=np.array(MEDIAPIPE33.names[::-1])),
    ),
    (r"'theta'.*\(4, any, 3\)", poses(theta=np.zeros((4, 168)))),
    (r"masks/cam00/000000\.png", image("masks/*/*.png", GREY)),
    (
        r"000001\.png.* 16 bits",
        image("masks/cam00/000001.png", GREY.astype(np.uint16)),
    ),
    (r"123456\.png", write("images/cam00/20240131120000123456.png", b"")),
    (r"masks/cam01/000002\.png", remove("masks/cam01/000002.png")),
    (r"000001\.png.*16x12", image("masks/cam01/000001.png", GREY[::2, ::2])),
    (r"000001\.png", write("images/cam00/000001.png", b"")),
    (r"000000\.jpg.*CMYK", cmyk),
    (
        r"000001\.png.*palette",
        write("labels/cam00/000001.png", png(32, 24, 8, 3, bytes(32))),
    ),
    (r"000001\.png.*0001\.png", write("images/cam00/0001.png", b"")),
]


# -- published formats


def annots(change: Callable[[Any], object]) -> Damage:
    return objects("annots.npy", change)


def params(**values: Any) -> Damage:
    return objects("new_params/2.npy", lambda content: content.update(values))


def T_times(factor: float) -> Damage:
    return annots(
        lambda c: c["cams"].update(
            T=[factor * np.array(T) for T in c["cams"]["T"]]
        )
    )


def out_of_the_folder(content: Any) -> None:
    content["ims"][0].update(ims=["../x/0.jpg", *content["ims"][0]["ims"][1:]])


ZJU: list[Case] = [
    (r"annots\.npy", remove("annots.npy")),
    (r"annots\.npy", cut("annots.npy", 0.5)),
    (
        r"annots\.npy.*(posix|nt|os)\.system",
        lambda root: write_object(root / "annots.npy", {"cams": Evil()}),
    ),
    (r"annots\.npy.*'cams'", annots(lambda c: c.pop("cams"))),
    ("3 K, 3 R, 3 T, 0 D, 3 image", annots(lambda c: c["cams"].pop("D"))),
    ("3 D, 0 image", annots(lambda c: c.update(ims=[]))),
    ("images", remove("Camera_B1", "Camera_B2", "Camera_B3")),
    (r"annots\.npy.*T .*0\.00\d+ m", T_times(1e-3)),
    ("new_params/", remove("new_params")),
    (
        "new_params",
        lambda root: [
            path.rename(path.with_name(f"9{path.name}"))
            for path in (root / "new_params").iterdir()
        ],
    ),
    (r"2\.npy.*'poses'.* 72 .*69", params(poses=np.zeros((1, 66)))),
    (r"poses.*found 87 \(SMPL-X with 6", params(poses=np.zeros((1, 87)))),
    (r"2\.npy.*'poses'.* 0", params(poses=np.full((1, 72), 0.1))),
    ("'Rh'", params(Rh=np.full((1, 3), np.nan))),
    (r"2\.npy.*'Rh'", objects("new_params/2.npy", lambda c: c.pop("Rh"))),
    (
        "inside: .*%",
        objects(
            "new_params/*.npy",
            lambda c: c.update(Th=c["Th"] + [[0.6, 0.8, 0.0]]),
        ),
    ),
    ("100% .*12 images", remove("mask", "mask_cihp")),
    (r"annots.*\.\./x", annots(out_of_the_folder)),
]


def people(
    change: Callable[[list[Any]], object], kind: str = "keypoints3d"
) -> Damage:
    return edited(f"{kind}/000001.json", change)


EASYMOCAP: list[Case] = [
    (r"extri\.yml.*T_10", replaced("extri.yml", "T_10:", "T_11:")),
    (r"extri\.yml", remove("extri.yml")),
    (
        "images/4 .*1, 2, 10",
        lambda root: shutil.copytree(root / "images/1", root / "images/4"),
    ),
    ("images", remove("images")),
    ("images/2", empty("images/2")),
    (
        r"images/2/000000\.jpg.*40x40.*80x40",
        replaced("intri.yml", "W_2: 40", "W_2: 80"),
    ),
    ("person 0.*'keypoints3d'", people(lambda p: p[0].pop("keypoints3d"))),
    ("'id'.*0", people(lambda p: p.append(p[0]))),
    (r"000001\.json", people(lambda p: p.append(3))),
    (r"000001\.json.*JSON", write("keypoints3d/000001.json", b"[" * 5000)),
    ("inside: .*%", image("mask/*/*.png", np.eye(40, dtype=np.uint8) * 255)),
    (r"mask/1/000000\.png", remove("mask")),
]


def fitted(**values: Any) -> Damage:
    return arrays("smpl_params.npz", lambda held: held.update(values))


THUMAN4: list[Case] = [
    (
        r"missing_img_files\.txt.*line 1",
        write("missing_img_files.txt", b"\xffnothing here\n"),
    ),
    (
        r"missing_img_files\.txt.*cam01",
        write(
            "missing_img_files.txt",
            b"".join(b"cam01/%08d.jpg\n" % i for i in range(4)),
        ),
    ),
    ("images/cam01", remove("images/cam01")),
    (r"calibration\.json", remove("calibration.json")),
    (
        "cam02.*K, R and T",
        edited("calibration.json", lambda c: c["cam02"].pop("R")),
    ),
    (
        r"cam02.*'K'.*\(9,\)",
        edited("calibration.json", lambda c: c["cam02"].update(K=[1, 2])),
    ),
    (r"\(4, 63\).*\(4, 69\)", fitted(body_pose=np.zeros((4, 69)))),
    (r"\(4, 45\).*PCA", fitted(left_hand_pose=np.zeros((4, 12)))),
    (
        r"smpl_params\.npz.*transl",
        arrays("smpl_params.npz", lambda a: a.pop("transl")),
    ),
    (" 30 .* 10", fitted(betas=np.ones((1, 30)))),
    ("'betas'", fitted(betas=np.full((1, 10), np.nan))),
    (r"smpl_params\.npz", fitted(transl=np.full((4, 3), np.inf))),
    (
        r"smpl_params\.npz.*system.*nothing was run",
        fitted(betas=np.array(Evil())),
    ),
]


FORMATS: dict[str, tuple[list[Case], Callable[[Path], object]]] = {
    "capture": (CAPTURE, read_capture),
    "zju": (
        ZJU,
        lambda root: ZjuReader()(root, Thresholds(), str(SMPL["smpl"])),
    ),
    "easymocap": (
        EASYMOCAP,
        lambda root: EasymocapReader()(root, Thresholds()),
    ),
    "thuman4": (
        THUMAN4,
        lambda root: Thuman4Reader()(root, Thresholds(), str(smplx_once())),
    ),
}
SMPL: dict[str, Path] = {}


@pytest.fixture(scope="module")
def written(tmp_path_factory, subject, smpl_file):
    """A folder in every format; do not write into it."""
    SMPL["smpl"], root = smpl_file, tmp_path_factory.mktemp("formats")
    write_tiny_capture(root / "capture")
    write_original(root / "zju", subject)
    write_easymocap(root / "easymocap", subject)
    write_thuman4(root / "thuman4", smplx_subject(smplx_once()))
    return {name: root / name for name in FORMATS}


@pytest.mark.parametrize(
    ("kind", "fact", "damage"),
    [(kind, *case) for kind, (cases, _) in FORMATS.items() for case in cases],
)
def test_damage_is_refused_in_one_sentence(
    written, tmp_path, kind, fact, damage
):
    root = Path(shutil.copytree(written[kind], tmp_path / kind))
    damage(root)
    with pytest.raises(DataError, match=fact) as caught:
        FORMATS[kind][1](root)
    assert "\n" not in str(caught.value)
    assert str(root) in str(caught.value)
    assert not NEVER.exists()


BAD_WHEN_DECODED: list[Case] = [
    (r"images/cam00/000001\.jpg", cut("images/cam00/000001.jpg", 0.995)),
    (r"masks/cam00/000001\.png", cut("masks/cam00/000001.png", 0.6)),
    (r"images/cam00/000001\.jpg", remove("images/cam00/000001.jpg")),
    ("16x12.*32x24", image("images/cam00/000001.jpg", GREY[::2, ::2])),
    (r"000001\.png.*0 and 1", image("masks/cam00/000001.png", GREY + 1)),
    (r"000001\.png.* 3.* 3", image("labels/cam00/000001.png", GREY + 3)),
]


@pytest.mark.parametrize(("fact", "damage"), BAD_WHEN_DECODED)
def test_a_damaged_image_is_refused_when_it_is_read(tmp_path, fact, damage):
    names = {"label_names": ["background", "upper", "lower"]}
    layout = read_capture(
        write_tiny_capture(tmp_path, suffix="jpg", labels=True, meta=names)
    )
    dataset = CaptureDataset(layout, items(layout))
    damage(tmp_path)
    assert dataset[0].frame_id == 0
    with pytest.raises(DataError, match=fact) as caught:
        dataset[1]
    assert "\n" not in str(caught.value)


# -- the model file, folders and settings


def zju(root: Path, smpl: Path | None, **settings: Any) -> Layout:
    return ZjuReader(**settings)(
        root, Thresholds(), None if smpl is None else str(smpl)
    )


def test_model_files_that_do_not_fit(written, tmp_path):
    with pytest.raises(DataError, match=r"data\.smpl=/path"):
        zju(written["zju"], None)
    with pytest.raises(ConfigError, match=r"data\.smpl=.*none\.pkl"):
        zju(written["zju"], tmp_path / "none.pkl")
    write_smpl(tmp_path / "x.npz", "smplx", vertices=60)
    with pytest.raises(DataError, match=r"x\.npz.* 55 .*24"):
        zju(written["zju"], tmp_path / "x.npz")
    write_smpl(tmp_path / "small.pkl", vertices=60)
    with pytest.raises(DataError, match=r"small\.pkl.* 60 .*6890"):
        zju(written["zju"], tmp_path / "small.pkl")


@pytest.mark.parametrize(
    ("frames", "message"),
    [("a-b", "'a-b'"), ("0-9", "0-9")],
)
def test_frames_to_drop_that_cannot_be(written, frames, message):
    with pytest.raises(
        ConfigError, match=f"data.reader.drop_frames.*{message}"
    ):
        zju(written["zju"], SMPL["smpl"], drop_frames=frames)


def test_wrong_folders_and_frame_numbers(tmp_path):
    with pytest.raises(DataError, match="nowhere"):
        read_capture(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match=r"\bfile\b"):
        read_capture(tmp_path / "file")
    assert last_number("frame_0000000000000012") == 12
    assert last_number("1000000001") is None
    assert last_number("9" * 5000) is None
