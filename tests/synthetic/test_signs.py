"""The signs: joints within their limits, hands that touch and cross, unseen signs, the cameras."""

import numpy as np
import pytest
from mannequin import assert_limits, inside
from scipy.spatial import cKDTree
from tiny_characters import TINY

from gsgan.motion.rig import SIDES, Rig
from gsgan.motion.rotations import axis_angle
from gsgan.synthetic.gltf import AVATARS, read_character
from gsgan.synthetic.passages import HELD_OUT, frame_times, split_signs
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.scene_setup import (
    Scene,
    SceneSettings,
)
from gsgan.synthetic.takes import MOTIONS, read_take
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
    source = RecordedMotion(polo, MOTIONS["signs"])
    return source.at(frame_times(120, source.duration))


@pytest.fixture(scope="module")
def take(polo):
    return read_take(MOTIONS["signs"], Rig(polo))


def test_signs_are_short_and_some_are_held_out_whole(take, signing):
    seconds = np.diff(take.ends, prepend=0)
    assert len(set(take.passages)) == len(seconds) == 12
    assert ((seconds > 1.5) & (seconds < 2.5)).all()
    assert set(HELD_OUT) < set(take.passages)
    names = signing.passages
    train, test = split_signs(names, 30)
    assert len(test) == 30
    assert {names[i] for i in test} == set(HELD_OUT)
    assert {names[i] for i in train} == set(take.passages) - set(HELD_OUT)
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
    source = RecordedMotion(polo, MOTIONS["signs"])
    moves = source.at(np.arange(0, source.duration, 0.02))
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


def test_hands_touch_and_do_not_pass_through_each_other(polo, take):
    bones = np.array(polo.bones)[polo.dominant_bones()]
    arms = [
        np.flatnonzero(
            [b.startswith((f"{side}Hand", f"{side}ForeArm")) for b in bones]
        )
        for side in SIDES
    ]
    meshes = [polo.faces[np.isin(polo.faces, arm).all(axis=1)] for arm in arms]
    start = dict(zip(take.passages, [0, *take.ends], strict=False))
    times = np.array(
        [start[name] + since for name, (since, _) in TOGETHER.items()]
    )
    moves = RecordedMotion(polo, MOTIONS["signs"]).at(times)
    for name, R, joints in zip(
        TOGETHER, moves.rotations, moves.joints, strict=True
    ):
        vertices, _ = polo.skin(R, joints)
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
