"""The synthetic dataset: complete or absent, reproducible, with consistent files."""

from __future__ import annotations

import hashlib
import json
import math
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from gsgan.body.free import free_body
from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.data.synthetic import ensure_synthetic, make
from gsgan.data.synthetic.choreography import COMBINATION, held_out, passage_names
from gsgan.data.synthetic.identity import SHIRT_PATTERNS, albedo, make_identity, marks_of
from gsgan.data.synthetic.motion import (
    SIDES,
    matrix_to_axis_angle,
    motion,
    swing_twist,
    two_bone,
)
from gsgan.data.synthetic.scene_setup import Settings, build_scene, dataset_key
from gsgan.data.synthetic.trace import (
    Light,
    Person,
    PosedPerson,
    Tracer,
    View,
    majority,
    pixel_offsets,
    pixel_rays,
)
from gsgan.scene import BodyPose
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
# Largest rotation of a person's joint against its parent, radians, the fingers' middle and last
# joints in one. The first match counts.
JOINT_LIMITS = (
    (r"root", math.pi),
    (r"spine\d\d", 0.45),
    (r"neck\d\d|head", 0.45),
    (r"clavicle|shoulder01", 0.45),
    (r"upperarm01", 2.6),
    (r"upperarm02", 1.2),
    (r"lowerarm01", 2.6),
    (r"lowerarm02|wrist", 1.2),
    (r"finger\d-\d", 1.9),
    (r"upperleg01", 2.2),
    (r"upperleg02", 0.9),
    (r"lowerleg01", 2.6),
    (r"foot", 1.0),
    (r".*", 0.5),
)


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
    scene = build_scene(Settings(**{**TINY, "size": 24}))
    person, digest = scene.posed(1), hashlib.sha256()
    for view in scene.views.values():
        for pixels in person.render(view, 1):
            whole = pixels if pixels.dtype.kind == "i" else np.floor(255 * pixels + 0.5)
            digest.update(whole.astype(np.uint8).tobytes())
    assert digest.hexdigest() == DEFAULT


def test_left_and_right_labels_lie_on_left_and_right_landmarks():
    scene = build_scene(Settings(**{**TINY, "size": 96, "frames": 8}))
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
    scene = build_scene(Settings(frames=24, test_frames=6))
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
    scene = build_scene(Settings(frames=2, test_frames=1))
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
    monkeypatch.setattr(make, "_write", lambda *_: pytest.fail("made twice"))
    assert tiny(dataset.parents[2]) == dataset


def test_an_interrupt_leaves_nothing(tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(make, "_write_skeletons", stop)
    with pytest.raises(KeyboardInterrupt):
        tiny(tmp_path, frames=1, test_frames=0)
    assert [p.suffix for p in folder(tmp_path).iterdir()] == [".lock"]


def test_failing_worker_is_reported_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(make.sys, "executable", "false")
    with pytest.raises(DataError, match="workers=1"):
        tiny(tmp_path, workers=2)
    assert [p.suffix for p in folder(tmp_path).iterdir()] == [".lock"]


def test_leftovers_of_a_killed_process_are_cleared(tmp_path, monkeypatch):
    name = dataset_key(Settings(**TINY))
    (folder(tmp_path) / f".{name}.part-abc" / "images").mkdir(parents=True)
    monkeypatch.setattr(make, "_write", lambda part, *_: (part / "meta.json").write_text("{}"))
    tiny(tmp_path)
    assert sorted(p.name for p in folder(tmp_path).iterdir()) == [f".{name}.lock", name]


def test_unwritable_folder_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="GSGAN_CACHE"):
        tiny(tmp_path / "file")


def test_an_incomplete_folder_is_not_taken_for_a_dataset(tmp_path, monkeypatch):
    (folder(tmp_path) / dataset_key(Settings(**TINY)) / "images").mkdir(parents=True)
    monkeypatch.setattr(make, "_write", lambda part, *_: (part / "meta.json").write_text("{}"))
    with pytest.raises(DataError, match="cannot be written"):
        tiny(tmp_path)


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
        ({"tint": -0.1}, r"tint must be in \[0, 0.3\]"),
        ({"tint": True}, "tint must be"),
        ({"gloss": 2}, r"gloss must be in \[0, 1\]"),
        ({"gloss": float("nan")}, "gloss must be"),
        ({"test_scale": [1]}, "other than 1"),
        ({"test_scale": [9]}, "test_scale must list"),
        ({"test_scale": [2, 2.0]}, "twice"),
        ({"test_scale": 2}, "test_scale must be"),
        ({"test_scale": [2], "test_cameras": 0}, "set test_cameras"),
    ],
)
def test_parameters_out_of_range_are_refused(parameters, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        ensure_synthetic(cache=tmp_path, **parameters)
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- the motion


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_joints_stay_within_their_limits(seed):
    theta, _, _ = motion(120, seed)
    largest = theta.norm(dim=-1).amax(0)
    for name, angle in zip(free_body().joint_names, largest.tolist(), strict=True):
        stem = name.split(".")[0]
        limit = next(limit for pattern, limit in JOINT_LIMITS if re.fullmatch(pattern, stem))
        assert angle <= limit, name


def test_knees_bend_forwards():
    body = free_body()
    theta, transl, _ = motion(120, 0)
    p = body.posed_landmarks(BodyPose(theta, transl))
    heading = torch.linalg.cross(
        p[:, 23] - p[:, 24], torch.tensor([0.0, 0.0, 1.0]).expand(120, 3)
    )  # right to left, times up
    for hip, knee, ankle in ((23, 25, 27), (24, 26, 28)):
        off = p[:, knee] - (p[:, hip] + p[:, ankle]) / 2
        assert ((off * heading).sum(-1) > 0).all()


def test_motion_is_smooth():
    theta, transl, _ = motion(1680, 0)  # 48 frames a second
    step = (theta[1:] - theta[:-1]).norm(dim=-1).max()
    assert step < 0.3
    assert (transl[1:] - transl[:-1]).norm(dim=-1).max() < 0.05


def test_feet_stay_above_the_floor():
    theta, transl, _ = motion(60, 0)
    v = free_body().posed_vertices(BodyPose(theta, transl))
    assert v[..., 2].min() > -0.005


def test_fingers_move_while_signing():
    theta, _, passages = motion(60, 0)
    now = [i for i, name in enumerate(passages) if name == "signing"]
    for side in SIDES:
        finger = free_body().joint_names.index(f"finger2-1.{side}")
        assert theta[now, finger].norm(dim=-1).std() > 0.1


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_every_camera_sees_the_whole_motion(seed):
    """Cameras are placed by fewer moments than this: those between them must fit as well."""
    scene = build_scene(Settings(frames=350, test_frames=60, seed=seed))
    for frame in range(0, 350, 5):
        vertices = scene.vertices(frame)[::23]
        for view in scene.views.values():
            pixels = view.project(vertices)
            assert pixels.min() > 1
            assert pixels.max() < 127


def test_freestyle_has_poses_of_no_other_passage():
    theta, _, names = motion(350, 0)
    turned = axis_angle_to_matrix(theta[:, 1:]).flatten(1)  # without the root
    free = torch.tensor([name == "freestyle" for name in names])
    named = turned[~free]
    nearest = torch.cdist(turned[free], named).amin(dim=1)
    within = torch.cdist(named, named).fill_diagonal_(torch.inf).amin(dim=1)
    assert nearest.median() > 3 * within.median()


def test_held_out_frames_are_blocks_and_one_whole_passage():
    test, names = held_out(84, 21), passage_names(84)
    assert len(test) == len(set(test)) == 21
    combination = [i for i, n in enumerate(names) if n == COMBINATION]
    assert set(combination) <= set(test)
    rest = [i for i in test if i not in combination]
    assert all(i - 1 in rest or i + 1 in rest for i in rest)  # blocks, not single frames
    assert {names[i] for i in range(84) if i not in test} == set(names) - {COMBINATION}


@pytest.mark.parametrize("frames", [1, 2, 7, 30])
def test_held_out_count_is_exact(frames):
    for count in range(frames):
        test = held_out(frames, count)
        assert len(set(test)) == count
        assert set(test) < set(range(frames))
    with pytest.raises(ValueError, match="less than frames"):
        held_out(frames, frames)


def test_two_bone_reaches_its_target_with_the_right_lengths():
    target = torch.tensor([[0.3, -0.2, -0.3], [9.0, 0, 0]], dtype=torch.float64)
    pole = torch.tensor([[0.0, 1, 0], [0, 1, 0]], dtype=torch.float64)
    upper, lower = two_bone(target, pole, 0.3, 0.25)
    end = 0.3 * upper + 0.25 * lower
    torch.testing.assert_close(end[0], target[0], atol=1e-12, rtol=0)
    torch.testing.assert_close(end[1, 0], torch.tensor(0.99 * 0.55, dtype=torch.float64))
    assert upper[0, 1] > target[0, 1] / target[0].norm()  # bends to the pole's side


def test_swing_and_twist_multiply_to_the_rotation():
    axis = torch.tensor([0.0, 0.6, -0.8], dtype=torch.float64)
    R = axis_angle_to_matrix(torch.tensor([[0.7, -0.2, 0.4]], dtype=torch.float64))
    swing, angle = swing_twist(R, axis)
    torch.testing.assert_close(swing @ axis_angle_to_matrix(angle[:, None] * axis), R)
    torch.testing.assert_close(swing @ axis, R @ axis)
    torch.testing.assert_close(
        matrix_to_axis_angle(R), torch.tensor([[0.7, -0.2, 0.4]], dtype=torch.float64)
    )


# ---------------------------------------------------------------- the tracer


def square(z, half):
    """Two triangles facing up at a height."""
    v = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return v, np.array([[0, 1, 2], [0, 2, 3]])


def from_above(size=20, height=3.0, focal=20.0):
    """A camera that looks straight down."""
    R = np.diag([1.0, -1.0, -1.0])
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return View(K, R, np.array([0, 0, height]), (size, size))


def flat_person(*squares):
    v = np.concatenate([s[0] for s in squares])
    f = np.concatenate([s[1] + 4 * i for i, s in enumerate(squares)])
    marks = marks_of(free_body().landmarks.double().numpy())
    labels = np.repeat(np.arange(1, len(squares) + 1), 2)
    nothing = np.zeros((0, 3))
    return Person(v, f, labels, np.full(len(f), 2), nothing, nothing, make_identity(0), marks)


def test_square_covers_exactly_its_pixels():
    person = flat_person(square(1.0, 0.5))  # 2 m below the camera: 20 px / m / 2 m, 10 pixels wide
    moment = PosedPerson(person, person.vertices, np.zeros(0), Light(direction=(0, 0, 1)))
    _, alpha, labels = moment.render(from_above(), 4)
    expected = np.zeros((20, 20))
    expected[5:15, 5:15] = 1
    assert np.array_equal(alpha, expected)
    assert np.array_equal(labels, expected)


def test_shading_matches_the_formula():
    person = flat_person(square(1.0, 0.5))
    light = Light(direction=(0.0, 3.0, 4.0), sun=0.5, sky=0.3, ground=0.1)
    image, _, _ = PosedPerson(person, person.vertices, np.zeros(0), light).render(from_above(), 1)
    point = np.array([[0.45, 0.45, 1.0]])
    paint = albedo(person.identity, person.marks, point, np.array([2])) ** 2.2
    np.testing.assert_allclose(image[5, 14], (paint[0] * (0.5 * 0.8 + 0.3)) ** (1 / 2.2), rtol=1e-6)


def test_shadow_falls_away_from_the_sun():
    person = flat_person(square(0.0, 1.0), square(0.5, 0.1))
    light = Light(direction=(1.0, 0.0, 1.0), sun=0.5, sky=0.3, ground=0.3)
    view = from_above(size=60, focal=60.0)
    image, _, labels = PosedPerson(person, person.vertices, np.zeros(0), light).render(view, 1)
    assert set(np.unique(labels)) == {0, 1, 2}

    def at(x, y):
        u, v = np.floor(view.project(np.array([[x, y, 0.0]]))[0]).astype(int)
        return image[v, u]

    assert np.all(at(-0.5, 0) < at(-0.8, 0))  # 0.5 m high, light from +x at 45°: 0.5 m to -x
    np.testing.assert_allclose(at(-0.8, 0), at(0.6, 0.5))


def first_hits(triangles, origins, directions):
    """Every ray against every triangle (Möller and Trumbore): face and (u, v) of the nearest."""
    corner, edges = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
    p = np.cross(directions[:, None], edges[None, :, 1])
    determinant = (p * edges[:, 0]).sum(-1)
    offset = origins[:, None] - corner
    q = np.cross(offset, edges[None, :, 0])
    u, v = (offset * p).sum(-1) / determinant, (q * directions[:, None]).sum(-1) / determinant
    distance = (q * edges[:, 1]).sum(-1) / determinant
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    distance = np.where(hit, distance, np.inf)
    nearest, rows = distance.argmin(axis=1), np.arange(len(origins))
    face = np.where(hit.any(axis=1), nearest, -1)
    return face, np.stack([u[rows, nearest], v[rows, nearest]], axis=1)


def test_the_tracer_finds_the_first_triangle():
    rng = np.random.default_rng(0)
    triangles = rng.normal(size=(40, 3, 3))
    origins = rng.normal(size=(200, 3)) * 4
    directions = -origins + rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    face, uv = Tracer(triangles).first(origins, directions)
    expected, expected_uv = first_hits(triangles, origins, directions)
    assert (face >= 0).sum() > 50
    assert np.array_equal(face, expected)
    np.testing.assert_allclose(uv[face >= 0], expected_uv[face >= 0], atol=1e-4)


def test_bending_changes_the_cloth_and_only_the_cloth():
    scene = build_scene(Settings(**{**TINY, "size": 48}))
    view, vertices = scene.views["cam00"], scene.vertices(0)
    still = PosedPerson(scene.person, vertices, np.zeros(7), Light()).render(view, 1)
    bent = PosedPerson(scene.person, vertices, np.full(7, 1.5), Light()).render(view, 1)
    changed = np.abs(still[0] - bent[0]).max(axis=-1) > 1e-6
    cloth = (still[2] == 3) | (still[2] == 4)
    assert changed[cloth].mean() > 0.3
    assert not changed[~cloth].any()


def test_rays_pass_through_pixel_centres_first():
    offsets = pixel_offsets(5)
    assert offsets[0].tolist() == [0.5, 0.5]
    assert len(np.unique(offsets, axis=0)) == 5
    view = from_above()
    origin, directions = pixel_rays(view, (3, 4, 4, 5), 1)
    pixel = view.project(origin + directions)
    np.testing.assert_allclose(pixel, [[3.5, 4.5]])


def test_majority_of_rays():
    part = np.array([[[0, 0, 2, 2], [0, 0, 0, 2], [1, 2, 2, 0], [2, 1, 1, 2]]])
    assert majority(part, 3).tolist() == [[2, 0, 2, 1]]


# ---------------------------------------------------------------- the identity


def test_identities_differ_and_cover_the_patterns():
    people = [make_identity(i) for i in range(30)]
    assert len(set(people)) == 30
    assert {p.shirt_pattern for p in people} == set(SHIRT_PATTERNS)
    assert make_identity(4) == make_identity(4)
    with pytest.raises(ValueError, match="must not be negative"):
        make_identity(-1)


def test_albedo_is_a_colour_everywhere():
    body = free_body()
    points = body.vertices[body.faces].mean(1).double().numpy()
    surface = body.face_surface.numpy()
    marks = marks_of(body.landmarks.double().numpy())
    for seed in range(6):
        colour = albedo(make_identity(seed), marks, points, surface)
        assert colour.min() >= 0
        assert colour.max() <= 1
        assert colour[surface == 3].std() > 0.1  # the shirt has a pattern
