"""Sway and wrinkles: what is added to linear blend skinning."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from tiny_characters import character

from gsgan.motion.character import Animation
from gsgan.synthetic.secondary import LIMIT, Secondary

BONES = ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot")
JOINTS = ((0, 0, 1.0), (0, 0, 0.95), (0, 0, 0.5), (0, 0, 0.08))
TIMES = np.linspace(0, 4, 25)


def leg(label=2):
    """A trouser leg down to z = 0.05 that hangs on a chain of bones; rows 2.5 cm apart."""
    heights, around = (
        np.linspace(0.98, 0.05, 38),
        np.arange(16) * 2 * np.pi / 16,
    )
    z, angle = (
        x.ravel()
        for x in np.meshgrid(heights, np.append(around, 0), indexing="ij")
    )
    v = np.stack([0.08 * np.cos(angle), 0.08 * np.sin(angle), z], axis=1)
    i, j = (
        x.ravel()
        for x in np.meshgrid(np.arange(37), np.arange(16), indexing="ij")
    )
    # the last column is the first again, as at a uv seam
    a, b = 17 * i + j, 17 * i + j + 1
    faces = np.concatenate(
        [np.stack([a, a + 17, b], 1), np.stack([b, a + 17, b + 17], 1)]
    )
    c = character(
        [(v, faces, np.zeros((len(v), 2)))], bones=BONES, joints=JOINTS
    )
    below = np.clip((0.53 - z) / 0.06, 0, 1)
    index, weight = np.zeros((len(v), 4), int), np.zeros((len(v), 4))
    index[:, 0], index[:, 1], weight[:, 0], weight[:, 1] = (
        1,
        2,
        1 - below,
        below,
    )
    return replace(
        c,
        normals=np.stack([np.cos(angle), np.sin(angle), 0 * z], axis=1),
        labels=np.full(len(faces), label),
        label_names=("background", "hair", "lower_clothes", "left_leg"),
        bone_index=index,
        bone_weight=weight,
    )


@dataclass
class Swing:
    """The hips go to and fro, and the knee bends by ``bend * (1 + sin)`` radians."""

    reach: float = 0.0
    bend: float = 0.0
    drift: float = 0.0
    duration: float = 4.0

    def at(self, times):
        F, turn = len(times), 2 * np.pi * np.asarray(times)
        R = np.tile(np.eye(3), (F, len(BONES), 1, 1))
        angle = self.bend * (1 + np.sin(turn))
        R[:, 2:] = Rotation.from_rotvec(
            angle[:, None] * [1.0, 0, 0]
        ).as_matrix()[:, None]
        joints = np.zeros((F, len(BONES), 3))
        joints[:, 0] = JOINTS[0]
        joints[:, 0, 1] += self.reach * np.sin(turn) + self.drift * times
        rest = np.array(JOINTS)
        for child in range(1, len(BONES)):
            up = R[:, child - 1]
            joints[:, child] = joints[:, child - 1] + up @ (
                rest[child] - rest[child - 1]
            )
        return Animation(R, joints, {}, ("swing",) * F)


def frame(c, secondary, motion, time):
    """Skinned vertices and normals, and what becomes of them."""
    pose = motion.at(np.array([time]))
    X, N = c.skin(pose.rotations[0], pose.joints[0])
    return X, N, *secondary(time, pose.rotations[0], X, N)


def test_hems_sway_and_the_waist_does_not():
    c, motion = leg(), Swing(reach=0.15)
    secondary = Secondary(c, motion)
    offset = np.array(
        [
            y - x
            for x, _, y, _, _ in (frame(c, secondary, motion, t) for t in TIMES)
        ]
    )
    size = np.linalg.norm(offset, axis=-1)
    z = c.vertices[:, 2]
    assert size[:, z > 0.85].max() < 1e-3
    assert size[:, z < 0.2].max() > 0.01
    assert size.max() <= LIMIT
    low = offset[:, z < 0.2, 1].mean(axis=1)
    assert low.min() < -0.003 < 0.003 < low.max()  # to both sides


def test_steady_motion_does_not_sway():
    c = leg()
    still = Secondary(c, Swing())
    moving = Secondary(c, Swing(drift=1.0))
    for t in (0.0, 0.01, 1.7, 4.0):
        x, _, y, _, _ = frame(c, moving, Swing(drift=1.0), t)
        rest, _, at_rest, _, _ = frame(c, still, Swing(), t)
        np.testing.assert_allclose(y - x, at_rest - rest, atol=1e-5)
        # a vertical leg does not hang off its bone either
        assert np.abs(y - x).max() < 1e-5


def test_a_moment_does_not_depend_on_what_else_is_asked():
    c, motion = leg(), Swing(0.1, 0.4)
    once = frame(c, Secondary(c, motion), motion, 2.31)
    secondary = Secondary(c, motion)
    for t in (3.0, 0.2, 2.31):
        again = frame(c, secondary, motion, t)
    for a, b in zip(once[:4], again[:4], strict=True):
        assert np.array_equal(a, b)
    assert np.array_equal(once[4].slope, again[4].slope)


def test_the_mesh_does_not_tear():
    c, motion = leg(), Swing(0.15, 0.5)
    secondary = Secondary(c, motion)
    first, last = (
        np.arange(0, len(c.vertices), 17),
        np.arange(16, len(c.vertices), 17),
    )
    for t in TIMES[::4]:
        x, _, y, n, wrinkles = frame(c, secondary, motion, t)
        np.testing.assert_allclose(
            y[first], y[last], atol=1e-12
        )  # across the seam
        np.testing.assert_allclose(n[first], n[last], atol=1e-9)
        assert np.array_equal(wrinkles.slope[first], wrinkles.slope[last])
        offset = y - x
        for a, b in ((0, 1), (1, 2)):
            step = offset[c.faces[:, a]] - offset[c.faces[:, b]]
            assert np.linalg.norm(step, axis=1).max() < 0.012
        assert np.isfinite(n).all()
        np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-6)


def test_nothing_goes_below_the_floor():
    c, motion = leg(), Swing(0.3, 0.6)
    secondary = Secondary(c, motion)
    for t in TIMES:
        x, _, y, _, _ = frame(c, secondary, motion, t)
        assert np.all(y[:, 2] >= np.minimum(x[:, 2], 0) - 1e-12)


def test_wrinkles_deepen_as_a_joint_bends():
    c = leg()
    slopes = []
    for bend in (0.0, 0.3, 0.6):
        motion = Swing(bend=bend)
        slopes.append(frame(c, Secondary(c, motion), motion, 0.0)[4].slope)
    assert not slopes[0].any()
    assert 0 < slopes[1].max() < slopes[2].max() < 1
    z = c.vertices[:, 2]
    assert slopes[2].argmax() in np.flatnonzero(
        np.abs(z - 0.5) < 0.1
    )  # at the knee
    # the shank moves towards +y as the leg turns about +x: folds are deepest behind the knee
    knee = np.abs(z - 0.5) < 0.05
    y = c.vertices[:, 1]
    assert (
        slopes[2][knee & (y > 0.05)].mean()
        > 1.3 * slopes[2][knee & (y < -0.05)].mean()
    )


def test_skin_neither_sways_nor_wrinkles():
    c, motion = leg(label=3), Swing(0.15, 0.5)
    x, n, y, m, wrinkles = frame(c, Secondary(c, motion), motion, 1.25)
    assert np.array_equal(x, y)
    np.testing.assert_allclose(m, n, atol=1e-12)
    assert not wrinkles.slope.any()
