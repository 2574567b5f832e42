"""The signs: joints within their limits, hands that touch and cross, unseen signs, the cameras."""

import numpy as np
import pytest
from mannequin import assert_limits, inside, mannequin
from scipy.spatial import cKDTree
from tiny_characters import TINY

from gsgan.motion.rig import SIDES
from gsgan.motion.rotations import axis_angle
from gsgan.synthetic.controls import frame_times
from gsgan.synthetic.gltf import AVATARS, read_character
from gsgan.synthetic.posing import Choreography
from gsgan.synthetic.scene_setup import (
    VERSION,
    Scene,
    SceneSettings,
    dataset_key,
)
from gsgan.synthetic.signs import HELD_OUT, SIGNS, split_signs
from gsgan.utils.errors import ConfigError

# Signs of both hands: seconds from their start, and the arms' largest gap then, metres.
TOGETHER = {
    "interlace": (1.2, 0.003),
    "roof": (0.7, 0.003),
    "palms": (1.0, 0.003),
    "support": (1.0, 0.003),
    "point": (1.0, 0.004),
    "cancel": (0.55, 0.06),
    "hug": (1.1, 0.005),
    "peek": (0.7, 0.005),
}


@pytest.fixture(scope="module")
def polo():
    return read_character(AVATARS["polo"])


@pytest.fixture(scope="module")
def signing(polo):
    return Choreography(polo, programme=SIGNS).at(
        frame_times(120, SIGNS.duration)
    )


def test_other_scenes_are_what_they_were():
    assert VERSION == 2
    assert dataset_key(SceneSettings()) == "polo-128-c1f9a02e2386"
    assert dataset_key(SceneSettings(size=256)) == "polo-256-d319f51dfd30"
    assert dataset_key(SceneSettings(motion="signs")) != dataset_key(
        SceneSettings()
    )


def test_signs_are_short_and_some_are_held_out_whole():
    seconds = {name: duration for name, _, duration in SIGNS.passages}
    assert len(seconds) == 12
    assert all(1.5 <= duration <= 2.5 for duration in seconds.values())
    assert set(HELD_OUT) < set(seconds)
    moves = Choreography(mannequin(), programme=SIGNS).at(
        frame_times(120, SIGNS.duration)
    )
    names = moves.passages
    train, test = split_signs(names, 30)
    assert len(test) == 30
    assert {names[i] for i in test} == set(HELD_OUT)
    assert {names[i] for i in train} == set(seconds) - set(HELD_OUT)
    few_train, few = split_signs(names, 7)
    assert (
        few_train == train
    )  # the other frames of unseen signs do not train either
    assert set(few) < set(test)
    assert split_signs(names, 0) == (list(range(120)), [])
    with pytest.raises(ConfigError, match=r"roof, cancel, peek.* 30 .*120"):
        split_signs(names, 31)


def test_wrists_and_fingers_stay_within_their_limits(polo, signing):
    limits = {"Arm": 125, "ForeArm": 150, "Hand": 75, "HandIndex1": 100}
    assert_limits(polo, signing, limits, twisted=50)


def test_motion_is_smooth(polo):
    times = np.arange(0, SIGNS.duration, 0.02)
    moves = Choreography(polo, programme=SIGNS).at(times)
    turned = np.swapaxes(moves.rotations[:-1], -1, -2) @ moves.rotations[1:]
    assert np.linalg.norm(axis_angle(turned), axis=-1).max() < 0.7
    assert all((w >= 0).all() and (w <= 1).all() for w in moves.shapes.values())
    feet = [polo.bones.index(f"{side}ToeBase") for side in SIDES]
    assert (
        np.ptp(moves.joints[:, feet], axis=0).max() < 1e-3
    )  # the person stands still
    for shape in (
        "mouth_open",
        "mouth_round",
        "mouth_wide",
        "smile_left",
        "brow_up_left",
    ):
        assert moves.shapes[shape].max() > 0.5


def test_hands_touch_and_do_not_pass_through_each_other(polo):
    bones = np.array(polo.bones)[polo.dominant_bones()]
    arms = [
        np.flatnonzero(
            [b.startswith((f"{side}Hand", f"{side}ForeArm")) for b in bones]
        )
        for side in SIDES
    ]
    meshes = [polo.faces[np.isin(polo.faces, arm).all(axis=1)] for arm in arms]
    rows = zip(SIGNS.passages, SIGNS.ends, strict=True)
    start = {name: end - seconds for (name, _, seconds), end in rows}
    times = np.array(
        [start[name] + since for name, (since, _) in TOGETHER.items()]
    )
    moves = Choreography(polo, programme=SIGNS).at(times)
    for name, R, joints in zip(
        TOGETHER, moves.rotations, moves.joints, strict=True
    ):
        vertices, _ = polo.skinned(R, joints)
        left, right = (vertices[arm] for arm in arms)
        near = cKDTree(left).query(right)[0].min()
        assert near < TOGETHER[name][1], name
        assert inside(right, vertices, meshes[0]).mean() < 0.06, name
        assert inside(left, vertices, meshes[1]).mean() < 0.06, name


def test_a_scene_of_signs_is_split_by_sign_before_frontal_cameras():
    given = {"motion": "signs", "size": 48, "frames": 12, "test_frames": 3}
    given |= {"train_cameras": 6, "test_cameras": 2}
    scene = Scene(SceneSettings(**TINY | given))
    names = np.array(scene.motion.passages)
    assert set(names[scene.test_frames]) <= set(HELD_OUT)
    assert not set(names[scene.train_frames]) & set(HELD_OUT)
    centres = np.array([view.centre for view in scene.views.values()])
    vertices = scene.mesh(5)[0]
    around = np.degrees(
        np.arctan2(*(centres[:, :2] - vertices[:, :2].mean(0)).T * [[1], [-1]])
    )
    assert np.abs(around).max() < 75
    assert all(
        around[:6].min() < angle < around[:6].max() for angle in around[6:]
    )
    assert np.diff(np.sort(around)).min() > 5
    assert ((centres[:, 2] > 1.1) & (centres[:, 2] < 1.7)).all()
    head = vertices[vertices[:, 2] > vertices[:, 2].max() - 0.25]
    for view in scene.views.values():
        pixels = view.project(head)
        assert pixels.min() > 0
        assert pixels.max() < 48
        assert (
            view.project(vertices)[:, 1].max() > 60
        )  # feet are below the image
