"""Every motion format gives the skeletons that were written into it."""

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.utils._pytree import tree_map

from gsgan.body.shape import free_space, shape_body
from gsgan.body.smpl import read_smpl
from gsgan.motion.asf import asf_of, read_amc
from gsgan.motion.clip import complete, is_own, mask_unseen, resample, up_axis
from gsgan.motion.readers import Source, read_motion
from gsgan.motion.retarget import retarget
from gsgan.motion.rotations import rotation
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.proportions import BONES, measure_proportions, upright
from gsgan.utils.errors import ConfigError, DataError

FILES = Path(__file__).parent / "files"
# Landmarks and the joints of the SMPL family that lie there.
SMPL_AT = {
    11: 16,
    13: 18,
    15: 20,
    12: 17,
    14: 19,
    16: 21,
    23: 1,
    25: 4,
    27: 7,
    24: 2,
    26: 5,
    28: 8,
}
# of Z up: MediaPipe's image axes
Y_DOWN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def directions(p: np.ndarray) -> np.ndarray:
    bones = np.stack([p[:, b] - p[:, a] for a, b in BONES], axis=1)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


def standard(path: Path, proportions, **source) -> tuple[np.ndarray, object]:
    """The file's landmarks without gaps, Z up; and the motion."""
    motion = mask_unseen(read_motion(path, Source(proportions, **source)), 0.1)
    return complete(motion, motion.up or up_axis(motion)), motion


def write_pose(
    path: Path,
    parts: dict[str, tuple[list[str], np.ndarray]],
    layout: str = "XYZC",
    ignored: tuple[int, ...] = (),
) -> Path:
    """A .pose file of parts: names of points, and points ``[F, n, 3]`` with NaN where not seen."""
    pose_format = pytest.importorskip("pose_format")
    from pose_format.numpy import NumPyPoseBody
    from pose_format.pose_header import (
        PoseHeader,
        PoseHeaderComponent,
        PoseHeaderDimensions,
    )

    components = [
        PoseHeaderComponent(name, points, [(0, 1)], [(255, 0, 0)], layout)
        for name, (points, _) in parts.items()
    ]
    header = PoseHeader(0.1, PoseHeaderDimensions(640, 480, 0), components)
    q = np.concatenate([q for _, q in parts.values()], axis=1)
    seen = np.isfinite(q).all(-1)[:, None].astype(np.float64)
    seen[..., ignored] *= 0.4
    with path.open("wb") as stream:
        body = NumPyPoseBody(25, np.nan_to_num(q)[:, None], seen)
        pose_format.Pose(header, body).write(stream)
    return path


def test_landmarks(tmp_path, landmarks, proportions):
    path = tmp_path / "a.npz"
    np.savez(path, p=1000 * landmarks[..., [0, 2, 1]] * (1, 1, -1), fps=25)
    (tmp_path / "meta.json").write_text('{"unit": "mm", "up_axis": "y"}')
    p, motion = standard(path, proportions)
    assert motion.fps == 25
    turned = p @ (upright("y") @ np.array([[1, 0, 0], [0, 0, 1], [0, -1.0, 0]]))
    np.testing.assert_allclose(turned, landmarks, atol=1e-6)
    assert is_own(motion, proportions)


def test_body_poses_of_the_free_body(tmp_path, dance, landmarks, proportions):
    path = tmp_path / "a.npz"
    theta = dance.theta.numpy().copy()
    np.savez(
        path,
        theta=theta,
        transl=dance.transl.numpy(),
        frame_id=np.arange(len(theta)),
    )
    p, motion = standard(path, proportions)
    np.testing.assert_allclose(p, landmarks, atol=1e-5)
    theta[3, 0, 0] = np.nan
    np.savez(path, theta=theta, transl=dance.transl.numpy())
    p, motion = standard(path, proportions)
    assert motion.filled == 1
    for found in (p, motion.body.theta, motion.body.transl):
        assert np.isfinite(found).all()
        np.testing.assert_array_equal(found[3], found[2])


def test_body_poses_of_a_fitted_body(tmp_path, dance):
    """gsgan.fit writes the person's shape beside the poses, in the capture's unit."""
    shape = replace(free_space().neutral(), offsets=0.02 * torch.randn(33, 3))
    shape.stretch[:2] = 1.3
    np.savez(tmp_path / "body_shape.npz", **shape.arrays())
    (tmp_path / "meta.json").write_text('{"unit": "cm", "fps": 50}')
    path = tmp_path / "body_pose.npz"
    np.savez(path, theta=dance.theta.numpy(), transl=100 * dance.transl.numpy())
    posed = shape_body(shape).posed_landmarks(dance).double()
    own = measure_proportions(
        posed, torch.ones(posed.shape[:2], dtype=torch.bool), "z"
    )
    p, motion = standard(path, own)
    np.testing.assert_allclose(p, posed, atol=1e-5)
    assert motion.fps == 50
    assert is_own(motion, own)
    (tmp_path / "body_shape.npz").write_bytes(b"PK cut")
    with pytest.raises(DataError, match=r"body_shape\.npz"):
        standard(path, own)


@pytest.mark.parametrize("kind", ["smpl", "smplx"])
@pytest.mark.parametrize("numbers", [66, 72, 156, 165])
def test_smpl_and_amass(tmp_path, shared, proportions, kind, numbers):
    from writers.smpl import write_smpl

    end = "pkl" if kind == "smpl" else "npz"
    model = shared(f"{kind}.{end}", lambda path: write_smpl(path, kind=kind))
    path, poses = tmp_path / "a.npz", np.zeros((5, numbers))
    poses[:, 3 * 18 + 2] = 1.5  # the left elbow
    np.savez(
        path,
        poses=poses,
        trans=np.zeros((5, 3)),
        betas=np.zeros(16),
        mocap_framerate=120.0,
    )
    with pytest.raises(DataError, match="smpl="):
        standard(path, proportions)
    p, motion = standard(path, proportions, smpl=model)
    assert motion.fps == 120
    body = read_smpl(model)
    theta = torch.zeros(1, len(body.parents), 3, dtype=torch.float64)
    theta[0, 18, 2] = 1.5
    shape = body.v_template.new_zeros(1, 1)
    joints = body.pose(theta, shape, shape.new_zeros(1, 3))[1][0].numpy()
    truth = np.zeros((1, 33, 3))
    truth[0, list(SMPL_AT)] = (
        joints[list(SMPL_AT.values())] @ upright(up_axis(motion)).T
    )
    np.testing.assert_allclose(directions(p)[:1], directions(truth), atol=1e-6)
    np.savez(path, poses=poses[:, :50])
    with pytest.raises(DataError, match=" 50 "):
        standard(path, proportions, smpl=model)


@pytest.mark.parametrize("style", ["python", "tasks", "bare", "lists", "npz"])
def test_mediapipe(tmp_path, landmarks, proportions, style):
    landmarks = landmarks - landmarks[:, 23:25].mean(1, keepdims=True)
    q = landmarks @ Y_DOWN.T
    frames = [
        [{"x": x, "y": y, "z": z, "visibility": 0.9} for x, y, z in p]
        for p in q.tolist()
    ]
    content = {
        "python": {
            "fps": 25,
            "frames": [
                {"pose_world_landmarks": {"landmark": f}} for f in frames
            ],
        },
        "tasks": [{"worldLandmarks": [f], "landmarks": [f]} for f in frames],
        "bare": frames,
        "lists": q.tolist(),
    }
    path = tmp_path / "a.json"
    if style == "npz":
        path = tmp_path / "a.npz"
        np.savez(
            path,
            pose_world_landmarks=np.concatenate([q, np.ones((12, 33, 1))], -1),
            fps=25,
        )
    else:
        path.write_text(json.dumps(content[style]))
    p, motion = standard(path, proportions)
    assert up_axis(motion) == "-y"
    assert motion.fps == (25 if style in ("python", "npz") else None)
    np.testing.assert_allclose(
        p @ (upright("-y") @ Y_DOWN), landmarks, atol=1e-9
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "pose_world_landmarks"),
        ([{"pose_landmarks": []}], "frame 0.*pose_world_landmarks"),
        (
            [{"pose_world_landmarks": [{"x": 1}] * 33}],
            "frame 0.* 33 ",
        ),
        (
            [{"pose_world_landmarks": [[0, 0, 0]] * 17}],
            "frame 0.* 33 ",
        ),
        (
            [{"pose_world_landmarks": [[0, 0, float("inf")]] * 33}],
            "frame 0: expected 33 landmarks with finite",
        ),
        (
            [{"pose_world_landmarks": None}],
            "no joint of any frame has a position",
        ),
    ],
)
def test_bad_json(tmp_path, proportions, content, message):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=message):
        standard(path, proportions)


def test_image_landmarks_without_a_name_are_refused(
    tmp_path, landmarks, proportions
):
    """Their numbers are shares of the image, with which a person would be flat and drift."""
    image = landmarks @ Y_DOWN.T * 0.3 + (0.5, 0.8, 0)
    path = tmp_path / "a.json"
    path.write_text(json.dumps(image.tolist()))
    with pytest.raises(DataError, match="not its image landmarks"):
        standard(path, proportions)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("trans", np.zeros((4, 3))),
        ("trans", np.array("none")),
        ("betas", np.zeros(0)),
        ("poses", np.array(3.0)),
        ("poses", np.zeros((0, 72))),
    ],
)
def test_parameters_of_any_other_shape_are_named(
    tmp_path, shared, proportions, name, values
):
    from writers.smpl import write_smpl

    model = shared("smpl.pkl", lambda path: write_smpl(path, kind="smpl"))
    arrays = {"poses": np.zeros((5, 72)), "trans": np.zeros((5, 3))}
    path = tmp_path / "a.npz"
    np.savez(path, **arrays | {name: values})
    with pytest.raises(DataError, match=r"a\.npz"):
        standard(path, proportions, smpl=model)


def test_pose_files_with_axes_of_unknown_scale(
    tmp_path, landmarks, proportions
):
    names = [n.upper() for n in MEDIAPIPE33.names]

    def write(path, q, layout, name="POSE_WORLD_LANDMARKS"):
        write_pose(path, {name: (names, q)}, layout)

    path, q = tmp_path / "a.pose", landmarks @ Y_DOWN.T
    write(path, q * (687.0, 515.0, 1.07) + 250, "XYZC")
    p, motion = standard(path, proportions)
    assert motion.fps == 25
    assert is_own(motion, proportions)
    turned = directions(p @ (upright("-y") @ Y_DOWN))
    np.testing.assert_allclose(turned, directions(landmarks), atol=0.02)
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(DataError, match=r"a\.pose"):
        standard(path, proportions)
    write(path, q[..., :2], "XYC", "pose_keypoints_2d")
    with pytest.raises(
        DataError, match=r"pose_keypoints_2d.*POSE_WORLD_LANDMARKS"
    ):
        standard(path, proportions)


def test_people_filmed_from_the_waist_up_stand_upright(
    tmp_path, landmarks, proportions
):
    names, q = [n.upper() for n in MEDIAPIPE33.names], landmarks @ Y_DOWN.T
    world = ("POSE_WORLD_LANDMARKS", (names, q[::-1]))
    q[:, 23:25, 2] -= 0.5  # MediaPipe's guess
    parts = {"POSE_LANDMARKS": (names, q * (640, 640, 1)), world[0]: world[1]}
    p, _ = standard(
        write_pose(tmp_path / "a.pose", parts, ignored=(23, 24)), proportions
    )
    spine = p[:, 11:13].mean(1) - p[:, 23:25].mean(1)
    np.testing.assert_allclose(spine[:, :2], 0, atol=1e-9)
    assert (spine[:, 2] > 0.4).all()
    across = [
        x[:, 11] - x[:, 12] for x in (p @ (upright("-y") @ Y_DOWN), landmarks)
    ]
    across = [x / np.linalg.norm(x, axis=-1, keepdims=True) for x in across]
    # image landmarks, not the world's
    assert (across[0] * across[1]).sum(-1).min() > 0.9


def test_bvh(tmp_path, proportions):
    from conventions import write_bvh
    from mannequin import choreography, mannequin

    person = mannequin()
    signing = choreography(person).at(21 + np.arange(30) / 30)
    path = write_bvh(tmp_path / "a.bvh", person, signing, 1 / 30, scale=100.0)
    p, motion = standard(path, proportions)
    assert motion.unit == "centimetres"
    names = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
    at = {
        i + 2 * k: signing.joints[:, person.bones.index(side + name)]
        for name, i in zip(names, (11, 13, 15, 23, 25, 27), strict=True)
        for k, side in enumerate(("Left", "Right"))
        for i in [i - k]
    }
    truth = np.zeros_like(p)
    for joint, position in at.items():
        truth[:, joint] = position
    # the reader turns the first frame towards -Y
    ours, theirs = (
        np.arctan2(*(x[0, 23] - x[0, 24])[[1, 0]]) for x in (p, truth)
    )
    yaw = rotation(np.array([0, 0, theirs - ours]))
    np.testing.assert_allclose(
        directions(p @ yaw.T), directions(truth), atol=1e-4
    )
    q = retarget(p, proportions)
    assert np.isfinite(q).all()
    path.write_text(path.read_text().replace("LeftLeg", "Tentacle"))
    with pytest.raises(DataError, match="LeftLeg"):
        standard(path, proportions)


BONES_OF_ASF = [  # name, parent, direction, length, dof
    ("lhipjoint", "root", (1, 0, 0), 1.6, ""), ("rhipjoint", "root", (-1, 0, 0), 1.6, ""),
    ("lfemur", "lhipjoint", (0, -1, 0), 7, "rx ry rz"), ("ltibia", "lfemur", (0, -1, 0), 7, "rx"),
    ("lfoot", "ltibia", (0, 0, 1), 2, "rx rz"), ("rfemur", "rhipjoint", (0, -1, 0), 7, "rx ry rz"),
    ("rtibia", "rfemur", (0, -1, 0), 7, "rx"), ("rfoot", "rtibia", (0, 0, 1), 2, "rx rz"),
    ("thorax", "root", (0, 1, 0), 8, "rx ry rz"), ("head", "thorax", (0, 1, 0), 3, "rx ry rz"),
    ("lclavicle", "thorax", (1, 0, 0), 3, ""), ("rclavicle", "thorax", (-1, 0, 0), 3, ""),
    ("lhumerus", "lclavicle", (1, 0, 0), 5, "rx ry rz"),
    ("lradius", "lhumerus", (1, 0, 0), 3, "rx"),
    ("lwrist", "lradius", (1, 0, 0), 1.5, "ry"), ("lhand", "lwrist", (1, 0, 0), 1, "rx rz"),
    ("rhumerus", "rclavicle", (-1, 0, 0), 5, "rx ry rz"),
    ("rradius", "rhumerus", (-1, 0, 0), 3, "rx"), ("rwrist", "rradius", (-1, 0, 0), 1.5, "ry"),
    ("rhand", "rwrist", (-1, 0, 0), 1, "rx rz"),
]  # fmt: skip


def write_amc(folder: Path) -> Path:
    """A T pose, then the left upper arm turned down; its elbow's axis is the file's z."""
    lines = [
        ":version 1.10",
        ":name VICON",
        ":units",
        "  mass 1.0",
        "  length 0.45",
        "  angle deg",
    ]
    lines += [
        ":root",
        "  order TX TY TZ RX RY RZ",
        "  axis XYZ",
        "  position 0 0 0",
    ]
    lines += ["  orientation 0 0 0", ":bonedata"]
    for name, _, way, length, dof in BONES_OF_ASF:
        axis = "0 90 0" if name == "lradius" else "0 0 0"
        lines += [
            "  begin",
            "    id 1",
            f"    name {name}",
            f"    direction {way[0]} {way[1]} {way[2]}",
        ]
        lines += [f"    length {length}", f"    axis {axis} XYZ"]
        if dof:
            lines += [
                f"    dof {dof}",
                *(["    limits (-90 90)"] + ["           (-90 90)"] * 2),
            ]
        lines.append("  end")
    lines += [":hierarchy", "  begin", "    root lhipjoint rhipjoint thorax"]
    for parent in dict.fromkeys(b[1] for b in BONES_OF_ASF if b[1] != "root"):
        lines.append(
            "    "
            + " ".join(
                [parent, *(b[0] for b in BONES_OF_ASF if b[1] == parent)]
            )
        )
    (folder / "07.asf").write_text("\n".join([*lines, "  end"]))
    frames = [":FULLY-SPECIFIED", ":DEGREES"]
    for number in (1, 2):
        frames += [str(number), "root 0 17 0 0 0 0"]
        for name, *_, dof in BONES_OF_ASF:
            values = [0.0] * len(dof.split())
            if number == 2 and name == "lhumerus":
                values[2] = -90.0
            if number == 2 and name == "lradius":
                values[0] = 90.0
            if dof:
                frames.append(" ".join([name, *map(str, values)]))
    path = folder / "07_01.amc"
    path.write_text("\n".join(frames))
    return path


def test_amc(tmp_path, proportions):
    path = write_amc(tmp_path)
    bvh, metres = read_amc(path, asf_of(path))
    assert metres == pytest.approx(0.0254 / 0.45)
    hand = bvh.pose()[:, bvh.names.index("lhand")]
    np.testing.assert_allclose(hand[0], [3 + 5 + 4.5, 17 + 8, 0], atol=1e-9)
    # C M C⁻¹ with C a quarter turn about y: about x in the bone's axes is about -z of the parent's
    np.testing.assert_allclose(hand[1], [3 - 4.5, 17 + 8 - 5, 0], atol=1e-9)
    p, motion = standard(path, proportions)
    assert motion.fps == 120
    assert motion.file_up == "y"
    along = directions(p)
    np.testing.assert_allclose(along[0, :2], [[1, 0, 0]] * 2, atol=1e-9)
    np.testing.assert_allclose(
        along[1, :2], [[0, 0, -1], [-1, 0, 0]], atol=1e-9
    )
    np.testing.assert_allclose(
        along[:, 4:], np.tile([0, 0, -1.0], (2, 4, 1)), atol=1e-9
    )


@pytest.mark.parametrize(
    ("file", "damage", "message"),
    [
        ("07_01.amc", lambda t: t[:-40], r"07_01\.amc.*frame "),
        (
            "07_01.amc",
            lambda t: t.replace("lfemur", "tail"),
            r"07_01\.amc.* tail",
        ),
        ("07_01.amc", lambda t: "", r"07_01\.amc|a\.npz"),
        ("07_01.amc", lambda t: t.replace("17", "nan"), r"07_01\.amc.*finite"),
        (
            "07.asf",
            lambda t: t[: len(t) // 2],
            r"07(_01)?\.(asf|amc)",
        ),
        (
            "07.asf",
            lambda t: t.replace("name lhand", "nome lhand"),
            r"07\.asf.*'name'",
        ),
    ],
)
def test_damaged_amc(tmp_path, proportions, file, damage, message):
    path = write_amc(tmp_path)
    (tmp_path / file).write_text(damage((tmp_path / file).read_text()))
    with pytest.raises(DataError, match=message):
        standard(path, proportions)


@pytest.mark.parametrize(
    ("section", "damage"),
    [
        ("root", "missing"),
        ("bonedata", "missing"),
        ("bonedata", "cut off"),
        ("hierarchy", "missing"),
        ("hierarchy", "cut off"),
    ],
)
def test_a_section_of_an_asf_that_is_cut_off_is_named(
    tmp_path, proportions, section, damage
):
    """Also where what is left would be a skeleton: a bone that was not ended was dropped."""
    path = write_amc(tmp_path)
    asf = tmp_path / "07.asf"
    before, _, after = asf.read_text().partition(f":{section}\n")
    own, sign, others = after.partition("\n:")
    if damage == "missing":
        own = ""
    else:
        own, _, _ = own.rpartition("end")
    asf.write_text(f"{before}:{section}\n{own}{sign}{others}")
    with pytest.raises(DataError, match=rf"07\.asf.*:{section} .*{damage}"):
        standard(path, proportions)


def test_an_amc_without_its_skeleton(tmp_path, proportions):
    path = write_amc(tmp_path)
    (tmp_path / "07.asf").rename(tmp_path / "x.asf")
    standard(path, proportions)  # the only one there
    (tmp_path / "y.asf").write_text("")
    with pytest.raises(DataError, match=r" 2 .*skeleton="):
        standard(path, proportions)
    standard(path, proportions, skeleton=tmp_path / "x.asf")


def test_other_files(tmp_path, proportions):
    for name, content, message in (
        ("a.fbx", b"x", r"a\.fbx.*FBX2glTF"),
        ("a.csv", b"x", r"a\.csv.*\.npz"),
        ("a.npz", b"", r"07_01\.amc|a\.npz"),
        ("b.npz", b"PK not a zip", r"b\.npz"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=message):
            standard(tmp_path / name, proportions)
    with pytest.raises(DataError, match=r"c\.bvh.*novel_pose"):
        standard(tmp_path / "c.bvh", proportions)
    np.savez(tmp_path / "d.npz", image=np.zeros(3))
    with pytest.raises(DataError, match=r"d\.npz"):
        standard(tmp_path / "d.npz", proportions)
    np.savez(tmp_path / "e.npz", p=np.zeros((0, 33, 3)))
    with pytest.raises(DataError, match=r"e\.npz"):
        standard(tmp_path / "e.npz", proportions)


def test_frame_rates(landmarks):
    assert len(resample(landmarks, 120, 30)) == 3
    np.testing.assert_allclose(resample(landmarks, 120, 30)[1], landmarks[4])
    half = resample(landmarks, 30, 60)
    assert len(half) == 23
    np.testing.assert_allclose(half[1], (landmarks[0] + landmarks[1]) / 2)
    assert resample(landmarks[:1], 24, 60).shape == (1, 33, 3)


def test_frames_without_a_trunk(tmp_path, landmarks, proportions):
    p = landmarks.copy()
    p[0] = p[11] = p[3] = p[4, [11, 23]] = np.nan
    p[2, 12] = np.nan  # one shoulder of a neighbour
    np.savez(tmp_path / "a.npz", p=p)
    motion = mask_unseen(
        read_motion(tmp_path / "a.npz", Source(proportions)), 0.1
    )
    assert motion.filled == 4
    np.testing.assert_array_equal(motion.p[0], landmarks[1])
    np.testing.assert_array_equal(motion.p[11], landmarks[10])
    np.testing.assert_allclose(
        motion.p[3, 15], landmarks[[2, 2, 5], 15].mean(0)
    )
    whole, _ = standard(tmp_path / "a.npz", proportions)
    assert np.isfinite(whole).all()
    np.savez(tmp_path / "a.npz", p=np.full_like(p, np.nan))
    with pytest.raises(DataError, match="no joint of any frame"):
        standard(tmp_path / "a.npz", proportions)


def test_landmarks_from_the_waist_up(tmp_path, landmarks, proportions):
    """Hips that no frame shows are placed below the shoulders, as when a capture is opened."""
    p = landmarks.copy()
    p[:, 23:] = np.nan
    np.savez(tmp_path / "a.npz", p=p)
    whole, motion = standard(tmp_path / "a.npz", proportions)
    assert motion.filled == 0
    assert np.isfinite(whole).all()
    spine = np.linalg.norm(
        whole[:, [23, 24]].mean(1) - whole[:, [11, 12]].mean(1), axis=-1
    )
    own = np.linalg.norm(
        proportions.rest[[23, 24]].mean(0) - proportions.rest[[11, 12]].mean(0)
    )
    np.testing.assert_allclose(spine, own, rtol=0.3)


def test_joints_out_of_sight(tmp_path, landmarks, proportions):
    p = landmarks.copy()
    p[3:6, 15] = np.nan  # a wrist for a moment: it moves evenly
    p[:, 14] = np.nan  # an elbow always: the arm hangs
    p[1:, 28] = np.nan  # an ankle that is seen once: a false guess
    np.savez(tmp_path / "a.npz", p=p)
    whole, _ = standard(tmp_path / "a.npz", proportions)
    assert np.isfinite(whole).all()
    middle = (whole[4, 15] - whole[4, 13]) - (
        landmarks[4, 15] - landmarks[4, 13]
    )
    assert np.linalg.norm(middle) < 0.04
    np.testing.assert_array_equal(whole[:, 13], landmarks[:, 13])
    assert np.linalg.norm(whole[0, 28] - landmarks[0, 28]) > 1e-3
    hang = directions(whole)[:, 2]
    assert (hang[:, 2] < 0).all()


@pytest.mark.parametrize("name", ["02_03.amc", "makehuman.bvh", "phone.bvh"])
def test_files_of_other_programs(proportions, name):
    p, _ = standard(FILES / name, proportions)
    q = retarget(p, proportions)
    assert np.isfinite(q[:, :33]).all()
    everywhere = torch.ones(q.shape[:2], dtype=torch.bool)
    again = measure_proportions(torch.from_numpy(q), everywhere, "z")
    lengths = [
        np.linalg.norm(f.rest[13] - f.rest[11]) for f in (again, proportions)
    ]
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-5)
    assert (q[:, 23:25, 2].mean(1) > q[:, 29:33, 2].min(1)).all()


def published(
    root: np.ndarray, body: np.ndarray, moves: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Arrays with published keys and shapes; ``body [F, 63]`` is of SMPL-H's 21 joints."""
    F = len(root)
    zeros = {n: np.zeros((F, n)) for n in (3, 6, 90)}
    x = np.concatenate([root, body, zeros[3], zeros[6], zeros[90]], axis=1)
    amass = {
        "trans": moves,
        "gender": np.array("neutral"),
        "betas": np.zeros(16),
    }
    parts = {"root_orient": root, "pose_body": body, "pose_hand": zeros[90]}
    parts |= {"pose_jaw": zeros[3], "pose_eye": zeros[6]}
    smplx = amass | parts | {"poses": x, "mocap_frame_rate": np.array(60.0)}
    smplx |= {
        "surface_model_type": np.array("smplx"),
        "num_betas": np.array(16),
    }
    smplx |= {"mocap_time_length": np.array(F / 60)}
    smpl = np.concatenate([body, zeros[6]], axis=1)
    return {
        "amass_smplh": amass
        | {
            "poses": x[:, [*range(66), *range(75, 165)]],
            "dmpls": np.zeros((F, 8)),
        }
        | {"mocap_framerate": np.array(60.0)},
        "amass_smplx": smplx | {"markers_latent": np.zeros((53, 3))},
        "stage_two": smplx | {"latent_labels": np.array(["ARIEL"] * 53)},
        "parts_only": {k: v for k, v in smplx.items() if k != "poses"},
        "humman": {"betas": np.zeros((F, 10)), "body_pose": smpl}
        | {"global_orient": root, "transl": moves},
        "wham": {
            "pose": np.full((F, 72), 0.7),  # in the camera's axes
            "trans": np.full((F, 3), 5.0),
            "pose_world": np.concatenate([root, smpl], axis=1),
            "trans_world": moves,
            "betas": np.zeros((F, 10)),
            "frame_ids": np.arange(F),
        },
        "gvhmr": {
            "smpl_params_incam": {"body_pose": np.full((F, 63), 0.7)},
            "smpl_params_global": {
                "body_pose": body,
                "global_orient": root,
                "transl": moves,
                "betas": np.zeros((F, 10)),
            },
            "K_fullimg": np.tile(np.eye(3), (F, 1, 1)),
        },
        "aist": {
            "smpl_poses": np.concatenate([root, smpl], axis=1),
            "smpl_trans": 95 * moves,
        }
        | {"smpl_scaling": np.array([95.0]), "smpl_loss": np.array([0.1])},
    }


@pytest.mark.parametrize(
    "name",
    [
        "amass_smplh",
        "amass_smplx",
        "stage_two",
        "parts_only",
        "humman",
        "wham",
        "gvhmr",
        "aist",
        "zju",
    ],
)
def test_published_keys_of_the_smpl_family(tmp_path, shared, proportions, name):
    from writers.smpl import write_smpl

    model = shared("smplx.npz", lambda path: write_smpl(path, kind="smplx"))
    rng = np.random.default_rng(2)
    root, body = (
        np.tile([0.1, 0.9, 0.2], (4, 1)),
        0.3 * rng.standard_normal((4, 63)),
    )
    moves = rng.standard_normal((4, 3))
    files = published(root, body, moves)
    skinned = read_smpl(model)
    if name == "zju":  # rotates about the model's origin
        J0 = skinned.rest_joints(torch.zeros(1, 10, dtype=torch.float64))[
            0, 0
        ].numpy()
        R = torch.from_numpy(rotation(root)).numpy()
        poses = np.concatenate(
            [np.zeros((4, 3)), body, np.zeros((4, 6))], axis=1
        )
        files[name] = {"poses": poses, "Rh": root, "Th": moves + J0 - (R @ J0)}
        files[name] |= {"shapes": np.zeros((4, 10))}
    suffixes = {"aist": "a.pkl", "zju": "a.npy", "gvhmr": "a.pt"}
    path = tmp_path / suffixes.get(name, "a.npz")
    if path.suffix == ".pkl":
        path.write_bytes(pickle.dumps(files[name]))
    elif path.suffix == ".pt":
        tensors = tree_map(
            lambda x: torch.from_numpy(np.asarray(x)), files[name]
        )
        torch.save(tensors, path)
    elif path.suffix == ".npy":
        np.save(path, np.array(files[name]), allow_pickle=True)
    else:
        np.savez(path, **files[name])
    motion = read_motion(path, Source(proportions, model))
    theta = torch.zeros(4, len(skinned.parents), 3, dtype=torch.float64)
    theta[:, :22] = torch.from_numpy(
        np.concatenate([root, body], axis=1)
    ).reshape(4, 22, 3)
    joints = skinned.pose(
        theta, theta.new_zeros(1, 1), torch.from_numpy(moves)
    )[1].numpy()
    np.testing.assert_allclose(
        motion.p[:, list(SMPL_AT)], joints[:, list(SMPL_AT.values())], atol=1e-6
    )


@pytest.mark.parametrize("suffix", [".npy", ".pth"])
def test_tracks_of_tram_are_read_in_the_world_of_its_camera(
    tmp_path, shared, proportions, suffix
):
    """A pickle of tensors; of frame 2 there is nothing, and camera.npy has the camera's way."""
    from writers.smpl import write_smpl

    model = shared("smplx.npz", lambda path: write_smpl(path, kind="smplx"))
    skinned = read_smpl(model)
    rng = np.random.default_rng(3)
    vectors = 0.3 * rng.standard_normal((4, 22, 3))
    moves = rng.standard_normal((4, 3))
    theta = torch.zeros(4, len(skinned.parents), 3, dtype=torch.float64)
    theta[:, :22] = torch.from_numpy(vectors)
    still = theta.new_zeros(1, 1)
    joints = skinned.pose(theta, still, torch.from_numpy(moves))[1].numpy()

    # The same person in the axes of a camera that moves.
    frames = np.array([0, 1, 3, 4])
    way = Rotation.random(5, random_state=0)
    places = rng.standard_normal((5, 3))
    root = skinned.rest_joints(torch.zeros(1, 10, dtype=torch.float64))
    root = root[0, 0].numpy()
    inverse = way[frames].inv()
    rotations = np.tile(np.eye(3), (4, 24, 1, 1))
    flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    rotations[:, :22] = flat.reshape(4, 22, 3, 3)
    rotations[:, 0] = inverse.as_matrix() @ rotations[:, 0]
    seen = inverse.apply(moves + root - places[frames]) - root
    track = {
        "pred_cam": torch.zeros(4, 3),
        "pred_rotmat": torch.from_numpy(rotations).float(),
        "pred_shape": torch.zeros(4, 10),
        "pred_trans": torch.from_numpy(seen).float()[:, None],
        "frame": torch.from_numpy(frames),
    }
    path = tmp_path / "hps" / f"hps_track_0{suffix}"
    path.parent.mkdir()
    if suffix == ".npy":
        np.save(path, track)
    else:
        torch.save(track, path)
    camera = {"world_cam_R": way.as_matrix(), "world_cam_T": places}
    np.save(tmp_path / "camera.npy", camera)
    motion = read_motion(path, Source(proportions, model))
    assert len(motion.p) == 5
    assert np.isnan(motion.p[2]).all()
    np.testing.assert_allclose(
        motion.p[frames][:, list(SMPL_AT)],
        joints[:, list(SMPL_AT.values())],
        atol=1e-5,
    )


def test_files_of_joblib_are_refused_with_a_way_to_convert_them(
    tmp_path, proportions
):
    """WHAM's own files are pickles of joblib's classes."""
    joblib = pytest.importorskip("joblib")
    person = {"pose_world": np.zeros((2, 72)), "trans_world": np.zeros((2, 3))}
    joblib.dump({0: person}, tmp_path / "wham_output.pkl")
    with pytest.raises(DataError, match=r"joblib.*numpy\.savez"):
        read_motion(tmp_path / "wham_output.pkl", Source(proportions))


@pytest.mark.parametrize("content", [{"a": 1}, [1], Path("x"), b"text"])
def test_other_pt_files_are_one_sentence(tmp_path, proportions, content):
    path = tmp_path / "a.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(DataError, match="smpl_params_global"):
        read_motion(path, Source(proportions))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], r"a\.pkl"),
        ({"poses": "none"}, "'poses'"),
        ({"verts": np.zeros((2, 6890, 3))}, "'poses' and 'trans'"),
        (Path("x"), "pathlib"),
    ],
)
def test_other_pickles_are_one_sentence(
    tmp_path, proportions, content, message
):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(DataError, match=message):
        read_motion(tmp_path / "a.pkl", Source(proportions))


def test_rows_of_landmarks_may_be_in_another_order_than_frames(
    tmp_path, landmarks, proportions
):
    order = np.random.default_rng(0).permutation(len(landmarks))
    path = tmp_path / "a.npz"
    np.savez(path, p=landmarks[order], frame_id=5 * order, fps=25)
    p, _ = standard(path, proportions)
    np.testing.assert_allclose(p, landmarks, atol=1e-6)


def test_frames_that_a_file_lacks_keep_their_time(
    tmp_path, landmarks, proportions
):
    """Every fifth frame was kept, and nobody was seen in two of these: a motion goes on there."""
    path = tmp_path / "a.npz"
    kept = [0, 1, 2, 3, 6, 7, 8, 9, 10, 11]
    np.savez(path, p=landmarks[kept], frame_id=100 + 5 * np.array(kept), fps=25)
    p, motion = standard(path, proportions)
    assert motion.filled == 2
    np.testing.assert_allclose(p[kept], landmarks[kept], atol=1e-6)
    between = landmarks[3] + (landmarks[6] - landmarks[3]) / 3
    np.testing.assert_allclose(p[4], between, atol=0.02)


def test_rotations_of_smpl_in_other_forms(tmp_path, shared, proportions):
    """Matrices, as 4D-Humans writes them, are converted; the others are refused."""
    from writers.smpl import write_smpl

    model = shared("smpl.pkl", lambda path: write_smpl(path, kind="smpl"))
    turns = 0.4 * np.random.default_rng(0).standard_normal((5, 24, 3))
    moves = {"trans": np.zeros((5, 3)), "fps": 30.0}
    path = tmp_path / "a.npz"
    np.savez(path, poses=turns.reshape(5, 72), **moves)
    expected = read_motion(path, Source(proportions, model)).p
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
    matrices = matrices.reshape(5, 24, 3, 3)
    np.savez(
        path,
        body_pose=matrices[:, 1:],
        global_orient=matrices[:, :1],
        **moves,
    )
    found = read_motion(path, Source(proportions, model)).p
    np.testing.assert_allclose(found, expected, atol=1e-6)

    quats = Rotation.from_rotvec(turns.reshape(-1, 3)).as_quat()
    for poses in (
        quats.reshape(5, 24, 4),
        quats.reshape(5, 96),
        matrices[..., :2].reshape(5, 144),
        np.degrees(turns).reshape(5, 72),
    ):
        np.savez(path, poses=poses, **moves)
        with pytest.raises(DataError, match=r"a\.npz.*rotation vectors"):
            read_motion(path, Source(proportions, model))


# ------------------------------------------------ SMPL's relatives


def smpl_h(path: Path, arrays: dict) -> None:
    """A model of SMPL-H: the arrays of SMPL, with fifteen joints for each hand."""
    body = arrays["kintree_table"][0, :22]
    parents = [*body, *[20] * 15, *[21] * 15]
    weights = np.zeros((6890, 52))
    weights[:, :22] = arrays["weights"][:, :22]
    weights[:, 30] = arrays["weights"][:, 22]
    weights[:, 40] = arrays["weights"][:, 23]
    regressor = arrays["J_regressor"]
    hands = [regressor[[22]].repeat(15, 0), regressor[[23]].repeat(15, 0)]
    new = {
        "kintree_table": np.array([parents, range(52)]),
        "weights": weights,
        "J_regressor": np.concatenate([regressor[:22], *hands]),
        "posedirs": np.zeros((6890, 3, 9 * 51)),
    }
    np.savez(path, **{**arrays, **new})


def test_relatives_of_smpl_are_the_same_motion(tmp_path, shared, proportions):
    from writers.smpl import smpl_arrays, write_smpl

    model = shared("smpl.pkl", lambda path: write_smpl(path, kind="smpl"))
    poses = np.zeros((5, 72))
    poses[:, 3 * 18 + 2] = 1.5  # the left elbow
    poses[:, 1] = np.arange(5) / 10
    move = np.zeros((5, 3))
    arrays = {"poses": poses, "trans": move, "betas": np.zeros(10)}
    np.savez(tmp_path / "smpl.npz", **arrays)
    truth, _ = standard(tmp_path / "smpl.npz", proportions, smpl=model)

    # Meshcapade's file, SLAHMR's with two people, GVHMR's as a pickle.
    body = poses[:, :66].reshape(5, 22, 3)
    with (tmp_path / "a.smpl").open("wb") as file:
        np.savez(
            file,
            bodyPose=body,
            bodyTranslation=move,
            shapeParameters=np.zeros(10),
            frameRate=30.0,
        )
    np.savez(
        tmp_path / "slahmr.npz",
        pose_body=np.stack([poses[:, 3:66]] * 2),
        root_orient=np.stack([poses[:, :3]] * 2),
        trans=np.stack([move] * 2),
        betas=np.zeros((2, 10)),
    )
    parameters = {
        "body_pose": poses[:, 3:66],
        "global_orient": poses[:, :3],
        "transl": move,
    }
    (tmp_path / "gvhmr.pkl").write_bytes(
        pickle.dumps({"smpl_params_global": parameters})
    )

    # EasyMocap's folder of fits: the root's rotation is apart, and poses have it too, empty.
    fits = tmp_path / "fits"
    fits.mkdir()
    for frame, row in enumerate(poses):
        fit = {
            "id": 0,
            "Rh": [row[:3].tolist()],
            "Th": [[0, 0, 0]],
            "poses": [[0, 0, 0, *row[3:].tolist()]],
            "shapes": [[0] * 10],
        }
        (fits / f"{frame:06d}.json").write_text(json.dumps([fit]))
    for name in ("a.smpl", "slahmr.npz", "gvhmr.pkl", "fits"):
        found, _ = standard(tmp_path / name, proportions, smpl=model)
        np.testing.assert_allclose(
            directions(found), directions(truth), atol=1e-6, err_msg=name
        )

    with pytest.raises(DataError, match=r"one frame .* motion=.*fits$"):
        standard(fits / "000000.json", proportions, smpl=model)

    # In a frame without a person the joints are missing.
    (fits / "000002.json").write_text("[]")
    clip = read_motion(fits, Source(proportions, smpl=model))
    assert np.isnan(clip.p).all((1, 2)).tolist() == [
        False,
        False,
        True,
        False,
        False,
    ]
    (fits / "000001.json").write_text(
        json.dumps([{"keypoints3d": [[0, 0, 0, 1]]}])
    )
    with pytest.raises(
        DataError, match=r"000001\.json: expected a fit of EasyMocap"
    ):
        read_motion(fits, Source(proportions, smpl=model))
    with pytest.raises(DataError, match="found keypoints3d"):
        read_motion(fits / "000001.json", Source(proportions))

    # AMASS' 52 joints with SMPL-H's model.
    smpl_h(tmp_path / "SMPLH.npz", smpl_arrays("smpl"))
    wide = np.zeros((5, 156))
    wide[:, :66] = poses[:, :66]
    np.savez(tmp_path / "amass.npz", **{**arrays, "poses": wide})
    found, _ = standard(
        tmp_path / "amass.npz", proportions, smpl=tmp_path / "SMPLH.npz"
    )
    np.testing.assert_allclose(directions(found), directions(truth), atol=1e-6)
    with pytest.raises(ConfigError, match="is a folder"):
        standard(tmp_path / "amass.npz", proportions, smpl=tmp_path)


@pytest.mark.parametrize("door", ["null frame", "named", "npz"])
def test_image_landmarks_are_refused_at_every_door(tmp_path, proportions, door):
    shares = np.random.default_rng(0).uniform(0.4, 0.6, (5, 33, 3))
    shares[:, [23, 24], 2] = 0
    path = tmp_path / "image.json"
    frames = shares.tolist()
    if door == "npz":
        path = tmp_path / "image.npz"
        np.savez(path, pose_world_landmarks=shares)
    elif door == "named":
        named = [{"pose_world_landmarks": frame} for frame in frames]
        path.write_text(json.dumps(named))
    else:
        path.write_text(json.dumps([None, *frames]))
    with pytest.raises(DataError, match="not its image landmarks"):
        read_motion(path, Source(proportions))


def test_arrays_without_a_unit_say_what_to_do(tmp_path, proportions):
    np.save(tmp_path / "freemocap.npy", np.ones((4, 33, 3)))
    with pytest.raises(DataError, match=r"numpy\.savez.*'p'"):
        read_motion(tmp_path / "freemocap.npy", Source(proportions))


def test_bare_lists_of_shares_of_an_image_are_refused(tmp_path, proportions):
    points = np.random.default_rng(0).uniform(0.2, 0.9, (4, 33, 3))
    path = tmp_path / "image.json"
    path.write_text(json.dumps(points.tolist()))
    with pytest.raises(DataError, match="not its image landmarks"):
        standard(path, proportions)


def test_markers_with_names_in_latin_1_are_read(tmp_path, proportions):
    path = tmp_path / "a.trc"
    path.write_bytes("PathFileType\t4\tübung.trc\n".encode("latin-1"))
    with pytest.raises(DataError) as caught:
        standard(path, proportions)
    assert "codec" not in str(caught.value)
