"""The synthetic dataset: complete or absent, reproducible, with consistent files."""

import hashlib
import json
import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from tiny_characters import TINY

from gsgan.body.free import free_body
from gsgan.data.datamodule import GsganData
from gsgan.scene import BodyPose
from gsgan.synthetic import ensure_scene, scenes
from gsgan.synthetic.free_subject import free_pose
from gsgan.synthetic.scene_setup import Scene, SceneSettings, dataset_key
from gsgan.synthetic.trace import PosedCharacter
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import cache_root

EACH_AVATAR = ("polo", pytest.param("blouse", marks=pytest.mark.slow))


def tiny(cache, **parameters):
    return ensure_scene(
        cache=cache, progress=False, **{"workers": 1, **TINY, **parameters}
    )


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny(tmp_path_factory.mktemp("made"))


def folder(cache):
    return cache / "data" / "synthetic"


def fingerprint(root):
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        if path.is_file():
            digest.update(
                str(path.relative_to(root)).encode() + path.read_bytes()
            )
    return digest.hexdigest()


def images(root, kind):
    paths = sorted((root / kind).rglob("*.png"))
    return [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in paths]


# ---------------------------------------------------------------- the dataset


def test_layout(dataset):
    meta = json.loads((dataset / "meta.json").read_text())
    cameras = json.loads((dataset / "cameras.json").read_text())
    splits = meta["splits"]
    assert sorted(cameras) == sorted(
        splits["train_cameras"] + splits["test_cameras"]
    )
    assert sorted(splits["train_frames"] + splits["test_frames"]) == [0, 1, 2]
    assert (meta["unit"], meta["up_axis"], meta["pixel_centre"]) == (
        "m",
        "z",
        0.5,
    )
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
        assert (
            f["conf"].shape
            == f["n_views"].shape
            == f["reproj_px"].shape
            == (3, 33)
        )
        assert f["frame_id"].tolist() == [0, 1, 2]
    with np.load(dataset / "hands3d.npz", allow_pickle=False) as f:
        assert f["p"].shape == (3, 42, 3)
    with np.load(dataset / "body_pose.npz", allow_pickle=False) as f:
        assert f["theta"].shape == (3, 56, 3)
        assert f["transl"].shape == (3, 3)


def test_mask_labels_and_image_agree(dataset):
    for image, mask, labels in zip(
        *(images(dataset, k) for k in ("images", "masks", "labels")),
        strict=True,
    ):
        assert image.shape == (32, 32, 3)
        assert mask.shape == labels.shape == (32, 32)
        assert np.array_equal(labels > 0, mask >= 128)
        assert image[mask == 0].max() == 0
        assert image[mask == 255].max(axis=-1).min() > 0
        assert labels.max() <= 12
        assert 0.02 < (mask > 0).mean() < 0.5


@pytest.mark.parametrize("avatar", EACH_AVATAR)
def test_the_baked_avatars_have_landmarks_labels_and_no_body_pose(
    avatar, tmp_path
):
    root = tiny(tmp_path, avatar=avatar)
    assert not (root / "body_pose.npz").exists()
    assert "body" not in json.loads((root / "meta.json").read_text())
    hands, face = (
        np.load(root / f"{name}3d.npz") for name in ("hands", "face")
    )
    assert hands["p"].shape == (3, 42, 3)
    assert face["p"].shape == (3, len(face["names"]), 3)
    assert not GsganData(root=str(root)).info.has_body_pose
    for mask, labels in zip(
        images(root, "masks"), images(root, "labels"), strict=True
    ):
        assert ((labels > 0) == (mask >= 128)).mean() >= 0.995


@pytest.mark.parametrize("avatar", EACH_AVATAR)
def test_landmarks_of_the_baked_avatars_lie_on_their_parts(avatar):
    """Both eyes and the mouth on the face, wrists on arms or hands, toes on shoes."""
    scene = Scene(
        SceneSettings(
            **TINY | {"avatar": avatar, "size": 160, "train_cameras": 2}
        )
    )
    names, points = scene.landmarks()
    expected = {
        "left_eye": "face",
        "mouth_left": "face",
        "nose": "face",
        "left_thumb": "hand",
    }
    expected |= {
        "right_index": "hand",
        "left_foot_index": "shoe",
        "right_heel": "shoe",
    }
    labels = scene.pose(1).render(scene.views["cam00"], 4)[
        2
    ]  # from before the person
    for name, part in expected.items():
        u, v = np.floor(
            scene.views["cam00"].project(points[1, [names.index(name)]])[0]
        ).astype(int)
        near = labels[v - 2 : v + 3, u - 2 : u + 3]
        found = {scene.character.label_names[i] for i in np.unique(near)}
        assert any(part in label for label in found), (name, found)


def test_person_is_in_view_and_fills_it():
    scene = Scene(
        SceneSettings(
            avatar="free_body", secondary=False, frames=24, test_frames=6
        )
    )
    top, bottom = [], []
    for frame in range(24):
        vertices = scene.mesh(frame)[0]
        for view in scene.views.values():
            pixels = view.project(vertices)
            assert pixels.min() > 0
            assert pixels.max() < 128
            top.append(pixels[:, 1].min())
            bottom.append(pixels[:, 1].max())
    assert max(bottom) - min(top) > 0.8 * 128


def test_test_cameras_are_between_training_cameras():
    scene = Scene(
        SceneSettings(
            avatar="free_body", secondary=False, frames=2, test_frames=1
        )
    )
    angle = {
        name: math.atan2(view.centre[0], -view.centre[1])
        for name, view in scene.views.items()
    }
    for test in scene.test_cameras:
        gaps = sorted(
            abs(math.remainder(angle[test] - angle[c], 2 * math.pi))
            for c in scene.train_cameras
        )
        assert math.degrees(gaps[0]) == pytest.approx(30, abs=4)
        assert math.degrees(gaps[1]) == pytest.approx(30, abs=4)


@pytest.mark.slow
def test_bytes_do_not_depend_on_workers(dataset, tmp_path):
    again = tiny(tmp_path, workers=2)
    assert fingerprint(again) == fingerprint(dataset)


def test_without_secondary_motion_the_mesh_is_skinned_and_landmarks_stay():
    still, moving = (
        Scene(SceneSettings(**TINY | {"secondary": on})) for on in (False, True)
    )
    vertices, _, wrinkles = still.mesh(1)
    assert wrinkles is None
    exact = free_body().posed_vertices(free_pose(still.motion))[1].numpy()
    np.testing.assert_allclose(vertices, exact, atol=1e-5)
    assert 0.002 < np.abs(moving.mesh(1)[0] - vertices).max() < 0.06
    np.testing.assert_array_equal(still.landmarks()[1], moving.landmarks()[1])


def test_the_free_bodys_pose_puts_its_landmarks_where_the_file_has_them(
    dataset,
):
    pose, p = (
        np.load(dataset / "body_pose.npz"),
        np.load(dataset / "landmarks3d.npz")["p"],
    )
    pose = BodyPose(
        torch.from_numpy(pose["theta"]), torch.from_numpy(pose["transl"])
    )
    np.testing.assert_allclose(
        free_body().posed_landmarks(pose).numpy(), p, atol=1e-6
    )


# ---------------------------------------------------------------- the cache


def test_a_ready_dataset_is_used_again(dataset, monkeypatch):
    monkeypatch.setattr(scenes, "_write", lambda *_: pytest.fail("made twice"))
    assert tiny(dataset.parents[2]) == dataset


def test_an_interrupted_dataset_is_continued(dataset, tmp_path, monkeypatch):
    render, left = PosedCharacter.render, 2

    def stops(self, view, rays):
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        return render(self, view, rays)

    with monkeypatch.context() as patch:
        patch.setattr(PosedCharacter, "render", stops)
        with pytest.raises(KeyboardInterrupt):
            tiny(tmp_path)
    root = folder(tmp_path) / dataset_key(SceneSettings(**TINY))
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
        "from pathlib import Path; from gsgan.synthetic import ensure_scene;"
        f"print(ensure_scene(cache=Path({str(tmp_path)!r}), workers=1, progress=False,"
        f" **{TINY!r}))"
    )
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    printed = {p.communicate()[0].strip() for p in processes}
    assert [p.returncode for p in processes] == [0, 0]
    assert len(printed) == 1
    folders = [
        p for p in (tmp_path / "data" / "synthetic").iterdir() if p.is_dir()
    ]
    assert [str(p) for p in folders] == list(printed)


def test_cache_root_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.delenv("GSGAN_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_root() == tmp_path / "gsgan"
    monkeypatch.setenv("GSGAN_CACHE", str(tmp_path / "mine"))
    assert cache_root() == tmp_path / "mine"


def test_key_depends_on_every_parameter():
    base = dataset_key(SceneSettings())
    changed = [
        SceneSettings(**{name: value})
        for name, value in (
            ("size", 64),
            ("train_cameras", 5),
            ("test_cameras", 1),
            ("frames", 61),
            ("test_frames", 14),
            ("rays_per_pixel", 5),
            ("seed", 1),
            ("avatar", "free_body"),
            ("secondary", False),
            ("lens", (0.1, 0, 0, 0)),
            ("lens", (0.1, 0, 0, 0, 0)),
            ("tint", 0.1),
            ("tint", 0.2),
            ("gloss", 0.1),
            ("test_scale", (2.0,)),
        )
    ]
    changed.append(SceneSettings(test_scale=(2.0,), tint=0.1))
    assert len({base, *map(dataset_key, changed)}) == 1 + len(changed)
    assert dataset_key(changed[-1]).endswith("-tint-test_scale")
    assert base == dataset_key(SceneSettings())


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"sise": 64}, "'sise'"),
        ({"size": 0}, "size"),
        ({"frames": 5, "test_frames": 5}, "test_frames.* 5"),
        ({"train_cameras": 2, "test_cameras": 3}, "test_cameras.* 2"),
        ({"lens": [0.1, 0.2]}, "lens.*4 .*5 .*8"),
        ({"lens": -0.2}, "lens"),
        ({"lens": [0.1, float("nan"), 0, 0]}, "lens"),
        ({"tint": -0.1}, r"tint.*0\.3"),
        ({"gloss": 2}, r"gloss.*1\.0"),
        ({"test_scale": [9]}, "test_scale"),
        ({"test_scale": [2], "test_cameras": 0}, "test_scale.*test_cameras"),
        (
            {"avatar": "nobody"},
            "avatar.*blouse, polo, free_body",
        ),
        (
            {"motion": "waltz"},
            r"motion.*\.bvh, \.amc, \.glb, \.gltf, \.vrma",
        ),
        ({"secondary": "some"}, "secondary.*True, False"),
        ({"avatar": "mine.glb"}, r"data.source.*mine.* does not exist"),
        ({"motion": "mine.bvh"}, r"data.source.*mine.* does not exist"),
    ],
)
def test_parameters_out_of_range_are_refused(parameters, message, tmp_path):
    error = DataError if "not exist" in message else ConfigError
    with pytest.raises(error, match=message):
        ensure_scene(cache=tmp_path, **parameters)
    assert not list(tmp_path.iterdir())
