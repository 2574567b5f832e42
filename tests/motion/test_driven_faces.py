"""Faces of motion files: the offset from a face at rest arrives in the axes of the driven head."""

import numpy as np
import pytest
import torch
from test_motion_readers import Y_DOWN, standard, write_pose

from gsgan.motion.clip import is_own
from gsgan.motion.retarget import (
    face_in_head,
    join,
    retarget,
    steady,
    transfer_face,
)
from gsgan.motion.rotations import rotation
from gsgan.skeleton import (
    HOLISTIC,
    MEDIAPIPE33,
    TEMPLATES,
    bone_frames,
    complete_skeleton,
    face_code,
    in_head,
    limb_length_sum,
)
from gsgan.skeleton.face import CODE_UNIT, FACE_NAMES
from gsgan.skeleton.joints import FACE, FACE_MESH
from gsgan.skeleton.template import HEAD
from gsgan.utils.errors import DataError

LOWER = [FACE_NAMES.index(f"mouth_outer_{k}") for k in (8, 9, 10)]
BROWS = [k for k, name in enumerate(FACE_NAMES) if "brow" in name]
STILL = [k for k in range(30) if k not in (*LOWER, *BROWS)]
POINTS = [str(number) for number in FACE_MESH.values()]
BIGGER = 1.15  # the other person's face
TURNED = rotation(np.array([0.2, 0.7, 0.0]))  # by 42 degrees


@pytest.fixture(scope="module")
def rest():
    """``[30, 3]`` the subject's face at rest, in the head's axes: up is y, ahead is z."""
    p = np.array(HOLISTIC.rest_positions)
    return p[FACE] - p[list(HOLISTIC.head)].mean(0)


@pytest.fixture(scope="module")
def moves():
    """``[12, 30, 3]`` offsets: two frames with an open mouth, two with raised brows."""
    offsets = np.zeros((12, 30, 3))
    offsets[3:5, LOWER] = 0, -0.012, 0.002
    offsets[8:10, BROWS] = 0, 0.006, 0
    return offsets


@pytest.fixture(scope="module")
def talking(signing, rest, moves):
    """``[12, 105, 3]`` another person with that face, whose head turns by itself."""
    heads, centre = head_of(signing)
    head = heads @ np.stack(
        [rotation(np.array([0, a, 0])) for a in np.linspace(-0.6, 0.6, 12)]
    )
    face = centre + BIGGER * (rest + moves) @ head.mT
    return np.concatenate([signing, face], axis=1)


def head_of(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes and centres of heads."""
    frames = bone_frames(torch.from_numpy(p[:, :33])).hubs[:, HEAD].numpy()
    return frames, p[:, MEDIAPIPE33.head].mean(1, keepdims=True)


def offsets_of(q: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """``[F, 30, 3]`` metres, in the axes of each frame's head."""
    face, body = torch.from_numpy(q[:, FACE]), torch.from_numpy(q[:, :33])
    return (
        in_head(
            face, body, bone_frames(body).hubs[:, HEAD], MEDIAPIPE33
        ).numpy()
        - rest
    )


def write_face(path, p: np.ndarray, kept: tuple[int, ...] = tuple(range(30))):
    """As MediaPipe gives it: image axes, pixels of an image of 640, z in widths of that image."""
    q = p @ Y_DOWN.T
    names = [n.upper() for n in MEDIAPIPE33.names]
    parts = {"POSE_WORLD_LANDMARKS": (names, q[:, :33])}
    pixels = 900 * q[:, FACE] * (1, 1, 1 / 640) + (90, 50, 0.1)
    parts["FACE_LANDMARKS"] = ([POINTS[k] for k in kept], pixels[:, list(kept)])
    return write_pose(path, parts)


def driven(path, proportions, rest) -> np.ndarray:
    """``[F, 105, 3]`` the subject as `gsgan.render` drives it, in standard axes."""
    p, motion = standard(path, proportions)
    p = p if motion.detached else face_in_head(p)
    p[:, FACE] = transfer_face(p[:, FACE], rest)
    return retarget(p, proportions)


def check(found: np.ndarray, moves: np.ndarray) -> None:
    """Magnitude and direction within 1.5 mm of 12 and 6, and nothing else moves more."""
    assert np.abs(found[:, LOWER] - moves[:, LOWER]).max() < 0.0015
    assert np.abs(found[:, BROWS] - moves[:, BROWS]).max() < 0.0015
    assert np.abs(found[:, STILL]).max() < 0.0015


def test_a_mouth_that_opens_opens_the_subjects(
    tmp_path, talking, signer, rest, moves
):
    q = driven(write_face(tmp_path / "a.pose", talking), signer, rest)
    assert np.isnan(q[:, 33:75]).all()  # the file has no hands
    check(offsets_of(q, rest), moves)


def test_the_source_may_be_turned_and_the_heads_of_both_differ(
    talking, rest, moves
):
    turned = 500 * steady(talking[:, FACE] @ TURNED.T) + 7
    check(transfer_face(turned, rest) - rest, moves)


def test_another_shape_of_face_is_no_expression(talking, rest, moves):
    wide = talking[:, FACE] + 0.1 * rest[::-1] * (1, 0, 0)
    one = transfer_face(wide[:1], rest)
    np.testing.assert_allclose(
        one[0], rest, atol=1e-9
    )  # a single frame is at rest


def test_a_file_may_lack_landmarks(tmp_path, talking, signer, rest, moves):
    kept = tuple(k for k in range(30) if k not in (0, 14, 27))
    q = driven(write_face(tmp_path / "a.pose", talking, kept), signer, rest)
    found = offsets_of(q, rest)
    assert np.isnan(found[:, [0, 14, 27]]).all()
    assert np.isfinite(found[:, list(kept)]).all()
    check(np.where(np.isnan(found), moves, found), moves)


def test_missing_faces_rest_and_short_gaps_are_bridged(
    tmp_path, talking, signer, rest
):
    p = talking.copy()
    p[1, FACE] = np.nan
    p[5:11, FACE] = np.nan  # six frames
    q = driven(write_face(tmp_path / "a.pose", p), signer, rest)
    assert np.isfinite(q[:5, FACE]).all()
    assert np.isnan(q[5:11, FACE]).all()
    height = float(limb_length_sum(torch.from_numpy(signer.rest[None])))
    whole, seen = complete_skeleton(torch.from_numpy(q), None, HOLISTIC, height)
    assert not seen[5:11, FACE].any()
    code = face_code(
        whole, bone_frames(whole, seen > 0, HOLISTIC).head, HOLISTIC
    )
    np.testing.assert_allclose(code[5:11], 0, atol=1e-3)
    assert code[3:5, LOWER, 1].max() * CODE_UNIT < -0.010
    for template in TEMPLATES.values():  # the smaller ones leave the face out
        assert (
            complete_skeleton(torch.from_numpy(q), None, template, height)[0]
            .isfinite()
            .all()
        )


@pytest.mark.parametrize("seen", [0, 1, 2])
def test_next_to_no_landmarks(talking, rest, seen):
    p = talking[:, FACE].copy()
    p[4:, seen:] = np.nan
    found = transfer_face(p, rest)
    assert np.isfinite(found[:4]).all()
    assert np.isnan(found[4:, seen:]).all()
    assert np.isnan(transfer_face(np.full_like(p, np.nan), rest)).all()


def test_landmarks_with_a_face(tmp_path, talking, signer, rest, moves):
    """An .npz file of 105 joints; the subject's own are not changed."""
    path, p = tmp_path / "a.npz", talking.copy()
    head, centre = head_of(p)
    p[:, FACE] = centre + BIGGER * (rest + moves) @ head.mT
    np.savez(path, p=p, fps=30)
    _, motion = standard(path, signer)
    assert is_own(motion, signer)
    np.testing.assert_array_equal(motion.p, p)
    check(offsets_of(driven(path, signer, rest), rest), moves)
    np.savez(path, p=talking[:, :80])
    with pytest.raises(DataError, match=r"'p'.* 80"):
        standard(path, signer)


def test_clips_with_and_without_a_face(talking, signer, rest, moves):
    p = talking.copy()
    p[:, FACE] = rest + moves[3]  # in the head's axes
    p = retarget(p, signer)
    bare = p.copy()
    bare[:, FACE] = np.nan
    found = join([p, p[::-1].copy(), bare], signer, 7)
    np.testing.assert_allclose(
        offsets_of(found[:31], rest), moves[[3] * 31], atol=1e-6
    )
    assert np.isnan(found[31:, FACE]).all()
    assert np.isfinite(found[:, :75]).all()
