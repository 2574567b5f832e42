"""The synthetic dataset: complete or absent, reproducible, with consistent files."""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from gsgan.body.free import free_body
from gsgan.data.synthetic import ensure_synthetic, scenes
from gsgan.data.synthetic.motion import motion
from gsgan.data.synthetic.scene_setup import Scene, Settings, dataset_key
from gsgan.data.synthetic.procedural import PosedPerson
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import cache_root

torch.set_num_threads(1)
TINY = {
    "size": 32,
    "train_cameras": 1,
    "test_cameras": 1,
    "frames": 3,
    "test_frames": 1,
    "rays_per_pixel": 1,
}
# sha256 of images, masks and labels in test_the_default_person_has_not_changed_by_a_bit; where it
# has to change, raise `gsgan.data.synthetic.scene_setup.VERSION` too.
DEFAULT = "3b2f48bdb2d3b0febe8b3760b4f0b1b0bb37fbb2a31d380df09f29849de8e8d6"


def tiny(cache, **parameters):
    return ensure_synthetic(cache=cache, progress=False, **{"workers": 1, **TINY, **parameters})


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny(tmp_path_factory.mktemp("made"))


def folder(cache):
    return cache / "data" / "synthetic"


def fingerprint(root):
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        if path.is_file():
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


def images(root, kind):
    paths = sorted((root / kind).rglob("*.png"))
    return [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in paths]


# ---------------------------------------------------------------- the dataset


def test_layout(dataset):
    meta = json.loads((dataset / "meta.json").read_text())
    cameras = json.loads((dataset / "cameras.json").read_text())
    splits = meta["splits"]
    assert sorted(cameras) == sorted(splits["train_cameras"] + splits["test_cameras"])
    assert sorted(splits["train_frames"] + splits["test_frames"]) == [0, 1, 2]
    assert (meta["unit"], meta["up_axis"], meta["pixel_centre"]) == ("m", "z", 0.5)
    assert meta["made_by"]["rays_per_pixel"] == 1
    assert meta["background"] == "black"
    for camera in cameras.values():
        assert camera["size"] == [32, 32]
        assert camera["dist"] == [0] * 5
        R = np.array(camera["R"])
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
    for kind in ("images", "masks", "labels"):
        assert len(images(dataset, kind)) == 6
    with np.load(dataset / "landmarks3d.npz", allow_pickle=False) as f:
        assert f["p"].shape == (3, 33, 3)
        assert f["conf"].shape == f["n_views"].shape == f["reproj_px"].shape == (3, 33)
        assert f["frame_id"].tolist() == [0, 1, 2]
    with np.load(dataset / "hands3d.npz", allow_pickle=False) as f:
        assert f["p"].shape == (3, 42, 3)
    with np.load(dataset / "body_pose.npz", allow_pickle=False) as f:
        assert f["theta"].shape == (3, 56, 3)
        assert f["transl"].shape == (3, 3)


def test_mask_labels_and_image_agree(dataset):
    for image, mask, labels in zip(
        *(images(dataset, k) for k in ("images", "masks", "labels")), strict=True
    ):
        assert image.shape == (32, 32, 3)
        assert mask.shape == labels.shape == (32, 32)
        assert np.array_equal(labels > 0, mask >= 128)
        assert image[mask == 0].max() == 0
        assert image[mask == 255].max(axis=-1).min() > 0
        assert labels.max() <= 12
        assert 0.02 < (mask > 0).mean() < 0.5


def test_every_part_is_seen(dataset):
    seen = np.unique(np.concatenate([x.ravel() for x in images(dataset, "labels")]))
    assert len(seen) >= 11  # of 13; a hand may hide behind the trunk in one tiny image


def test_landmarks_project_into_the_mask(dataset):
    cameras = json.loads((dataset / "cameras.json").read_text())
    points = np.load(dataset / "landmarks3d.npz")["p"].astype(np.float64)
    inside = []
    for name, camera in cameras.items():
        K, R, t = (np.array(camera[k]) for k in "KRt")
        for frame, p in enumerate(points):
            mask = cv2.imread(str(dataset / "masks" / name / f"{frame:06d}.png"), 0)
            near = cv2.dilate(mask, np.ones((3, 3)))  # a pixel is 7 cm here
            x = (p @ R.T + t) @ K.T
            assert (x[:, 2] > 1).all()
            u, v = np.floor(x[:, :2] / x[:, 2:]).astype(int).T
            inside.append(near[v, u] > 0)
    assert np.mean(inside) > 0.97


def test_the_default_person_has_not_changed_by_a_bit():
    scene = Scene(Settings(**{**TINY, "size": 24}))
    person, digest = scene.posed(1), hashlib.sha256()
    for view in scene.views.values():
        for pixels in person.render(view, 1):
            whole = pixels if pixels.dtype.kind == "i" else np.floor(255 * pixels + 0.5)
            digest.update(whole.astype(np.uint8).tobytes())
    assert digest.hexdigest() == DEFAULT


def test_left_and_right_labels_lie_on_left_and_right_landmarks():
    scene = Scene(Settings(**{**TINY, "size": 96, "frames": 8}))
    names, hits = free_body().label_names, 0
    for frame in range(0, 8, 2):
        p = free_body().posed_landmarks(scene.pose(frame))[0].double().numpy()
        person = scene.posed(frame)
        for view in scene.views.values():
            labels = person.render(view, 1)[2]
            for landmark, side in ((27, "left"), (28, "right")):
                u, v = np.floor(view.project(p[landmark : landmark + 1])[0]).astype(int)
                name = names[labels[v, u]]
                hits += name.startswith(side)
    assert hits >= 14  # of 16: one leg may hide the other


def test_person_is_in_view_and_fills_it():
    scene = Scene(Settings(frames=24, test_frames=6))
    top, bottom = [], []
    for frame in range(24):
        vertices = scene.vertices(frame)
        for view in scene.views.values():
            pixels = view.project(vertices)
            assert pixels.min() > 0
            assert pixels.max() < 128
            top.append(pixels[:, 1].min())
            bottom.append(pixels[:, 1].max())
    assert max(bottom) - min(top) > 0.8 * 128


def test_test_cameras_are_between_training_cameras():
    scene = Scene(Settings(frames=2, test_frames=1))
    angle = {
        name: math.atan2(view.centre[0], -view.centre[1]) for name, view in scene.views.items()
    }
    for test in scene.test_cameras:
        gaps = sorted(
            abs(math.remainder(angle[test] - angle[c], 2 * math.pi)) for c in scene.train_cameras
        )
        assert math.degrees(gaps[0]) == pytest.approx(30, abs=4)
        assert math.degrees(gaps[1]) == pytest.approx(30, abs=4)


@pytest.mark.slow
def test_bytes_do_not_depend_on_workers(dataset, tmp_path):
    again = tiny(tmp_path, workers=2)
    assert fingerprint(again) == fingerprint(dataset)


def test_another_identity_has_other_clothes_but_the_same_shape(dataset, tmp_path):
    other = tiny(tmp_path, identity=1)
    for a, b in zip(images(dataset, "labels"), images(other, "labels"), strict=True):
        assert np.array_equal(a, b)
    a, b = (np.stack(images(r, "images")).astype(float) for r in (dataset, other))
    shown = np.stack(images(dataset, "masks")) > 0
    assert np.abs(a - b)[shown].mean() > 10


def test_another_seed_gives_another_motion():
    assert (motion(20, 0)[0] - motion(20, 1)[0]).abs().max() > 0.1


# ---------------------------------------------------------------- the cache


def test_a_ready_dataset_is_used_again(dataset, monkeypatch):
    monkeypatch.setattr(scenes, "_write", lambda *_: pytest.fail("made twice"))
    assert tiny(dataset.parents[2]) == dataset


def test_an_interrupted_dataset_is_continued(dataset, tmp_path, monkeypatch):
    render, left = PosedPerson.render, 2

    def stops(self, view, rays):
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        return render(self, view, rays)

    with monkeypatch.context() as patch:
        patch.setattr(PosedPerson, "render", stops)
        with pytest.raises(KeyboardInterrupt):
            tiny(tmp_path)
    root = folder(tmp_path) / dataset_key(Settings(**TINY))
    assert len(images(root, "labels")) == 2
    assert not (root / "meta.json").exists()
    first = root / "images" / "cam00" / "000000.png"
    written = first.stat().st_mtime_ns
    assert tiny(tmp_path) == root
    assert first.stat().st_mtime_ns == written
    assert fingerprint(root) == fingerprint(dataset)


def test_failing_worker_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(scenes.sys, "executable", "false")
    with pytest.raises(DataError, match="workers=1"):
        tiny(tmp_path, workers=2)
    assert not list(tmp_path.rglob("meta.json"))


def test_unwritable_folder_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="GSGAN_CACHE"):
        tiny(tmp_path / "file")


@pytest.mark.slow
def test_two_processes_at_once(tmp_path):
    code = (
        "from pathlib import Path; from gsgan.data.synthetic import ensure_synthetic;"
        f"print(ensure_synthetic(cache=Path({str(tmp_path)!r}), workers=1, progress=False,"
        f" **{TINY!r}))"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    printed = {p.communicate()[0].strip() for p in processes}
    assert [p.returncode for p in processes] == [0, 0]
    assert len(printed) == 1
    folders = [p for p in (tmp_path / "data" / "synthetic").iterdir() if p.is_dir()]
    assert [str(p) for p in folders] == list(printed)


def test_cache_root_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.delenv("GSGAN_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_root() == tmp_path / "gsgan"
    monkeypatch.setenv("GSGAN_CACHE", str(tmp_path / "mine"))
    assert cache_root() == tmp_path / "mine"


def test_key_depends_on_every_parameter():
    base = dataset_key(Settings())
    changed = [
        Settings(size=64),
        Settings(train_cameras=5),
        Settings(test_cameras=1),
        Settings(frames=61),
        Settings(test_frames=14),
        Settings(rays_per_pixel=5),
        Settings(seed=1),
        Settings(identity=1),
        Settings(lens=(0.1, 0, 0, 0)),
        Settings(lens=(0.1, 0, 0, 0, 0)),
        Settings(tint=0.1),
        Settings(tint=0.2),
        Settings(gloss=0.1),
        Settings(test_scale=(2.0,)),
        Settings(test_scale=(2.0,), tint=0.1),
    ]
    assert len({base, *map(dataset_key, changed)}) == 1 + len(changed)
    assert dataset_key(changed[-1]).endswith("-tint-test_scale")
    assert base == dataset_key(Settings())


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"sise": 64}, "unknown parameter 'sise'"),
        ({"size": 0}, "size must be"),
        ({"frames": 5, "test_frames": 5}, "less than frames = 5"),
        ({"train_cameras": 2, "test_cameras": 3}, "at most 2"),
        ({"lens": [0.1, 0.2]}, "lens must list 4 or 5 or 8"),
        ({"lens": "strong"}, "lens must be"),
        ({"lens": -0.2}, "lens must be"),
        ({"lens": [0.1, float("nan"), 0, 0]}, "lens must be"),
        ({"tint": -0.1}, r"tint must be a number in \[0, 0.3\]"),
        ({"tint": True}, "tint must be"),
        ({"gloss": 2}, r"gloss must be a number in \[0, 1\]"),
        ({"gloss": float("nan")}, "gloss must be"),
        ({"test_scale": [9]}, "test_scale must be"),
        ({"test_scale": 2}, "test_scale must be"),
        ({"test_scale": [2], "test_cameras": 0}, "set test_cameras"),
    ],
)
def test_parameters_out_of_range_are_refused(parameters, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        ensure_synthetic(cache=tmp_path, **parameters)
    assert not list(tmp_path.iterdir())
