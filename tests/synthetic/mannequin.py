"""A small rig in a T pose for motion tests, points inside meshes."""

from collections.abc import Callable

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from gsgan.motion.character import Animation, Character
from gsgan.motion.rotations import axis_angle, twist
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.takes import MOTIONS

TRUNK = {
    "Hips": (None, (0, 0.02, 0.98)),
    "Spine": ("Hips", (0, 0.02, 1.04)),
    "Spine1": ("Spine", (0, 0.03, 1.14)),
    "Spine2": ("Spine1", (0, 0.03, 1.24)),
    "Neck": ("Spine2", (0, -0.02, 1.46)),
    "Head": ("Neck", (0, -0.04, 1.56)),
}
LIMBS = {  # of the left side
    "Shoulder": ("Spine2", (0.03, 0, 1.42)),
    "Arm": ("Shoulder", (0.17, 0, 1.41)),
    "ForeArm": ("Arm", (0.43, 0.01, 1.41)),
    "Hand": ("ForeArm", (0.67, 0, 1.41)),
    "UpLeg": ("Hips", (0.09, -0.02, 0.93)),
    "Leg": ("UpLeg", (0.09, -0.03, 0.52)),
    "Foot": ("Leg", (0.085, -0.01, 0.09)),
    "ToeBase": ("Foot", (0.085, -0.14, 0.03)),
}
ROWS = {
    "Thumb": -0.05,
    "Index": -0.03,
    "Middle": -0.01,
    "Ring": 0.012,
    "Pinky": 0.03,
}
for finger, y in ROWS.items():
    for k in range(1, 5):
        x = 0.69 + 0.02 * k if finger == "Thumb" else 0.73 + 0.03 * k
        above = "Hand" if k == 1 else f"Hand{finger}{k - 1}"
        LIMBS[f"Hand{finger}{k}"] = (
            above,
            (x, y - 0.01 * k * (finger == "Thumb"), 1.405),
        )
SHAPES = (
    "blink_left",
    "blink_right",
    "mouth_open",
    "smile_left",
    "brow_up_left",
)


def mannequin(without: Callable[[str], bool] = lambda bone: False) -> Character:
    """A person in a T pose: bones, the soles of both feet, a cylinder as trunk; no surfaces."""
    tree = dict(TRUNK)
    for side, sign in (("Left", 1), ("Right", -1)):
        for bone, (parent, (x, y, z)) in LIMBS.items():
            above = parent if parent in TRUNK else side + parent
            tree[side + bone] = (above, (sign * x, y, z))
    bones = tuple(bone for bone in tree if not without(bone))
    parents = []
    for bone in bones:
        parent = tree[bone][0]
        while parent is not None and without(parent):
            parent = tree[parent][0]
        parents.append(-1 if parent is None else bones.index(parent))
    joints = np.array([tree[bone][1] for bone in bones], dtype=float)
    points, index = [], []
    for side, sign in (("Left", 1), ("Right", -1)):
        for y in np.linspace(-0.2, 0.05, 11):
            toe = y < -0.14 and side + "ToeBase" in bones
            for x in (0.05, 0.085, 0.12):
                points.append((sign * x, y, 0.0))
                index.append(bones.index(side + ("ToeBase" if toe else "Foot")))
    vertices = np.array(points)
    bone_index = np.zeros((len(vertices), 4), dtype=np.int64)
    bone_index[:, 0] = index
    none = np.zeros(0, dtype=np.int64)
    return Character(
        name="mannequin",
        vertices=vertices,
        normals=np.tile([0.0, 0.0, -1.0], (len(vertices), 1)),
        uv=np.zeros((len(vertices), 2)),
        faces=np.zeros((0, 3), dtype=np.int64),
        material=none,
        labels=none,
        label_names=("background",),
        surfaces=(),
        bones=bones,
        parents=np.array(parents),
        joints=joints,
        bone_index=bone_index,
        bone_weight=np.tile([1.0, 0, 0, 0], (len(vertices), 1)),
        shapes={name: np.zeros_like(vertices) for name in SHAPES},
        anchor_names=(),
        anchor_joint=none,
        anchor_vertex=none,
    )


def inside(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Whether each point ``[N, 3]`` is within a mesh that is open above and below.

    A ray in a horizontal direction leaves the mesh where it hits a face from behind: three of
    four such rays have to.
    """
    scene = EmbreeScene()
    TriangleMesh(scene, vertices[faces].astype(np.float32))
    a, b, c = vertices[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    leaves = np.zeros(len(points))
    for angle in 0.2 + np.pi / 2 * np.arange(4):
        ray = np.array([np.cos(angle), np.sin(angle), 0.05])
        rays = np.tile(ray.astype(np.float32), (len(points), 1))
        hit = np.asarray(scene.run(points.astype(np.float32), rays)).astype(int)
        leaves += (hit >= 0) & (normal[hit] @ ray > 0)
    return leaves >= 3


def local(person: Character, motion: Animation, name: str) -> np.ndarray:
    """Rotations ``[F, 3, 3]`` of a bone against its parent, from the T pose."""
    j = person.bones.index(name)
    return (
        np.swapaxes(motion.rotations[:, person.parents[j]], -1, -2)
        @ motion.rotations[:, j]
    )


def assert_limits(
    person: Character, motion: Animation, limits: dict, twisted: float
) -> None:
    """Bones rotate at most so many degrees; forearms and hands, which wring skin, twist less."""
    for bone, limit in limits.items():
        for name in (
            (bone,) if bone in person.bones else ("Left" + bone, "Right" + bone)
        ):
            angle = np.degrees(
                np.linalg.norm(axis_angle(local(person, motion, name)), axis=-1)
            )
            assert angle.max() <= limit, (name, motion.passages[angle.argmax()])
    for name in ("LeftForeArm", "LeftHand", "RightForeArm", "RightHand"):
        assert (
            np.abs(np.degrees(twist(local(person, motion, name), 0))).max()
            < twisted
        ), name


def choreography(person: Character) -> RecordedMotion:
    """The everyday choreography on a character."""
    return RecordedMotion(person, MOTIONS["choreography"])
