"""ZJU-MoCap: each damage is one row of what is seen in practice, told in one sentence."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zju_folders
from writers.common import write_object, write_picture
from writers.smpl import write_smpl
from zju_folders import frame_of, read

from gsgan.utils.errors import ConfigError, DataError

pytestmark = pytest.mark.usefixtures("model_once")
written = zju_folders.written
original = zju_folders.original


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    content = np.load(path, allow_pickle=True).item()
    write_object(path, change(content) or content)


def annots(change: Callable[[Any], Any]) -> Callable[[Path], None]:
    return lambda root: edit(root / "annots.npy", change)


def cams(key: str, value: Callable[[Any], Any], index: int | None = 1) -> Callable[[Path], None]:
    def change(content: Any) -> None:
        entries = content["cams"][key]
        chosen = range(len(entries)) if index is None else [index]
        for i in chosen:
            entries[i] = value(np.array(entries[i]))

    return annots(change)


def params(**values: Any) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        edit(root / "new_params/2.npy", lambda content: content.update(values))

    return damage


def every_param(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        for path in (root / "new_params").iterdir():
            edit(path, change)

    return damage


def picture(name: str, array: np.ndarray) -> Callable[[Path], None]:
    return lambda root: write_picture(root / name, array)


def remove(*names: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        for name in names:
            path = root / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def cut(name: str, keep: float) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        data = (root / name).read_bytes()
        (root / name).write_bytes(data[: int(len(data) * keep)])

    return damage


def moved_body(root: Path) -> None:
    """Parameters of another take."""
    every_param(lambda c: c.update(Th=c["Th"] + [[0.6, 0.8, 0.0]]))(root)


class Evil:
    def __reduce__(self) -> Any:
        import os

        return os.system, ("touch /tmp/never",)


def evil(root: Path) -> None:
    array = np.array({"cams": Evil()}, dtype=object)
    np.save(root / "annots.npy", array, allow_pickle=True)


def shear(R: np.ndarray) -> np.ndarray:
    return R @ np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])


def folder_without_list(root: Path) -> None:
    annots(lambda content: content.update(ims=[]))(root)
    (root / "Camera_B4").mkdir()


def swapped_lists(root: Path) -> None:
    annots(lambda content: content["ims"][2]["ims"].reverse())(root)


GREY = np.zeros((40, 40), np.uint8)
BAD = {
    "no annots": (remove("annots.npy"), "is not a ZJU-MoCap subject: it has no annots.npy"),
    "annots cut": (cut("annots.npy", 0.5), "annots.npy is not a valid .npy file"),
    "annots of code": (evil, r"annots.npy asks for (posix|nt|os)\.system"),
    "no cams": (annots(lambda c: c.pop("cams") and None), "annots.npy has no 'cams'"),
    "no D": (annots(lambda c: c["cams"].pop("D") and None), "found 3 K, 3 R, 3 T, 0 D"),
    "K of fewer cameras": (
        annots(lambda c: c["cams"].update(K=c["cams"]["K"][:2])),
        "cams must hold one K, R, T and D per camera, found 2 K, 3 R",
    ),
    "ims of fewer cameras": (
        annots(lambda c: c["ims"][0].update(ims=c["ims"][0]["ims"][:2])),
        r"ims\[0\] lists 2 images, but cams has 3 cameras.*Camera_B1, Camera_B2",
    ),
    "ims in another order": (
        swapped_lists,
        r"ims\[2\] has Camera_B3 where ims\[0\] has Camera_B1",
    ),
    "no list, wrong number of folders": (
        folder_without_list,
        r"has 3 cameras and lists no images, but there are 4 image folders \(Camera_B1, ",
    ),
    "no pictures": (
        remove("Camera_B1", "Camera_B2", "Camera_B3"),
        "no camera folder holds images; expected e.g. Camera_B1/000000.jpg",
    ),
    "T in metres": (
        cams("T", lambda T: T / 1000, None),
        r"annots.npy: T is 0.00\d+ m long .*expected 0.05-20 m; this file's T is not",
    ),
    "T in micrometres": (
        cams("T", lambda T: T * 1000, None),
        r"annots.npy: T is \S+ m long .*expected 0.05-20 m",
    ),
    "Th in millimetres": (
        every_param(lambda c: c.update(Th=c["Th"] * 1000)),
        r"cameras stand .* expected 0.5-20 m; T in .*millimetres",
    ),
    "R sheared": (cams("R", shear), r"camera Camera_B2 \(index 1\): R is not a rotation"),
    "R mirrored": (cams("R", lambda R: R * [[1], [1], [-1]]), "Camera_B2 .*R mirrors"),
    "focal below 0": (
        cams("K", lambda K: K * [[1], [-1], [1]]),
        "focal lengths in K must be above",
    ),
    "D of 3": (cams("D", lambda D: D[:3]), "dist must hold 4, 5 or 8 finite numbers"),
    "K NaN": (cams("K", lambda K: K * np.nan), "'K' must hold finite numbers"),
    "no parameters": (
        remove("new_params"),
        "has no SMPL parameters; expected one of .*new_params/",
    ),
    "no common frame": (
        lambda root: [p.rename(p.with_name(f"9{p.name}")) for p in (root / "new_params").iterdir()],
        r"new_params has no parameters of any frame that has images; it holds 4 files",
    ),
    "poses of 66": (params(poses=np.zeros((1, 66))), r"2.npy: 'poses' must hold 72 or 69 numbers"),
    "root turned twice": (
        params(poses=np.full((1, 72), 0.1)),
        "2.npy: the first 3 numbers of 'poses' must be 0, found up to 0.1; .* belongs in Rh",
    ),
    "shapes of 16": (params(shapes=np.zeros((1, 16))), r"'shapes' must hold 10 numbers, found \(1"),
    "Th of 2": (params(Th=np.zeros((1, 2))), "'Th' must hold 3 numbers"),
    "Rh NaN": (params(Rh=np.full((1, 3), np.nan)), "'Rh' must hold finite numbers"),
    "poses text": (params(poses="none"), "'poses' must hold 72 or 69 numbers, found str"),
    "no Rh": (
        lambda root: edit(root / "new_params/2.npy", lambda c: c.pop("Rh") is None),
        "2.npy has no 'Rh'",
    ),
    "parameters cut": (cut("new_params/1.npy", 0.7), "1.npy is not a valid .npy file"),
    "pictures of another release": (
        moved_body,
        "the projected body and the masks do not meet .*check that cameras, SMPL parameters",
    ),
    "no masks": (remove("mask", "mask_cihp"), "100% of all 12 images have no mask"),
    "mask 16 bit": (
        lambda root: write_picture(root / "mask/Camera_B1/000000.png", GREY.astype(np.uint16)),
        "000000.png (holds uint16|has 16 bits)",
    ),
    "mask size": (
        picture("mask_cihp/Camera_B2/000000.png", np.ones((20, 20), np.uint8)),
        "000000.png is",
    ),
    "image empty": (
        lambda root: (root / "Camera_B3/000000.jpg").write_bytes(b""),
        "000000.jpg is not a valid PNG or JPEG",
    ),
    "image of another size": (
        picture("Camera_B3/000000.jpg", np.zeros((20, 30, 3), np.uint8)),
        "is 40x40 pixels .* has 30x20",
    ),
    "frame twice": (
        lambda root: shutil.copy(root / "Camera_B1/000001.jpg", root / "Camera_B1/0001.jpg"),
        "holds frame 1 twice",
    ),
    "leads out of the folder": (
        annots(lambda c: [e.update(ims=["../x/0.jpg", *e["ims"][1:]]) for e in c["ims"]] and None),
        "which is not a folder in it",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_damage_is_refused_in_one_sentence(original: Path, smpl_file: Path, name: str) -> None:
    damage, message = BAD[name]
    damage(original)
    with pytest.raises(DataError, match=message) as caught:
        read(original, smpl_file)
    assert "\n" not in str(caught.value)
    assert str(original) in str(caught.value)
    assert not Path("/tmp/never").exists()


def test_joints_need_a_model_file(written: Path) -> None:
    with pytest.raises(DataError, match=r"SMPL parameters but no joints.*data.smpl=/path"):
        read(written, None)


def test_model_files_that_do_not_fit(written: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data.smpl=.*none.pkl does not exist"):
        read(written, tmp_path / "none.pkl")
    write_smpl(tmp_path / "x.npz", "smplx", vertices=60)
    with pytest.raises(DataError, match=r"x.npz is a model of 55 joints.*SMPL \(24 joints\)"):
        read(written, tmp_path / "x.npz")
    write_smpl(tmp_path / "small.pkl", vertices=60)
    with pytest.raises(DataError, match=r"small.pkl has 60 vertices; expected the 6890 of SMPL"):
        read(written, tmp_path / "small.pkl")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"masks": "all"}, "data.reader.masks must be one of both, mask_cihp, mask, got 'all'"),
        ({"fit": "best"}, "data.reader.fit must be one of auto, refit, refined, first"),
        ({"drop_frames": "a-b"}, "data.reader.drop_frames must be frame numbers"),
        ({"drop_frames": "0-9"}, "leaves no frame"),
    ],
)
def test_settings_that_cannot_be(
    written: Path, smpl_file: Path, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        read(written, smpl_file, **settings)


@pytest.mark.parametrize("name", ["mesh_infos.pkl", "cam_params.json"])
def test_caches_of_other_projects_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(DataError, match=r"HumanNeRF or ARAH prepared.* give the original"):
        read(tmp_path, None)


def test_a_size_that_the_headers_did_not_show_is_found_on_decoding(
    original: Path, smpl_file: Path
) -> None:
    layout = read(original, smpl_file)
    write_picture(original / "Camera_B1/000001.jpg", np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(DataError, match=r"000001.jpg is 20x20 pixels .* Camera_B1 has 40x40"):
        frame_of(layout, 0, 1)
