"""Hands and face across views: swapped, missing, repeated and wild detections."""

import numpy as np
import pytest
from capture_scenes import no_outlines, ring, seen
from configs import solve_settings
from make import skeletons

from gsgan.prepare.camera_array import CameraArray
from gsgan.prepare.cleanse import cleanse
from gsgan.prepare.sides import apply_flips
from gsgan.prepare.solve import Solution, solve
from gsgan.skeleton.hands import FINGERS, HAND
from gsgan.skeleton.joints import BODY, FACE, HAND_PAIRS, HANDS, LEFT, RIGHT

FRAMES = 8


def hand(turn: float) -> np.ndarray:
    """``[21, 3]`` metres: spread fingers, from the wrist at the origin."""
    p = np.zeros((HAND, 3))
    for k, finger in enumerate(FINGERS):
        way = [np.cos(0.25 * k + turn), np.sin(0.25 * k + turn), 0.3]
        p[list(finger)] = np.outer((0.07, 0.1, 0.125, 0.145), way)
    return p


def person(frames: int = FRAMES) -> np.ndarray:
    """``[F, 105, 3]`` metres: a moving body with turning hands and a face."""
    body, face = (
        skeletons(frames),
        np.random.default_rng(1).uniform(-0.05, 0.05, (30, 3)),
    )
    hands = [
        np.stack(
            [body[f, wrist] + hand(0.1 * f + wrist) for f in range(frames)]
        )
        for wrist in (15, 16)
    ]
    return np.concatenate([body, *hands, body[:, :1] + face], axis=1)


def solved(rig: CameraArray, uv: np.ndarray, conf: np.ndarray) -> Solution:
    conf = np.where(np.isfinite(uv).all(-1), conf, 0.0)
    settings = solve_settings(refinements=0, body=False)
    without = no_outlines(*conf.shape[:2])
    return solve(rig, np.arange(FRAMES) / 30, uv, conf, without, settings)


def swap(uv: np.ndarray, swapped: np.ndarray) -> np.ndarray:
    return apply_flips(uv, swapped[..., None], [HAND_PAIRS])


def off(found: Solution, p: np.ndarray, part: slice) -> float:
    """Metres, the worst joint; NaN counts as infinite."""
    return float(
        np.nan_to_num(np.linalg.norm(found.p - p, axis=-1), nan=np.inf)[
            :, part
        ].max()
    )


def test_hands_that_agree_are_left_alone():
    rig, p, uv, conf = seen(ring(), noise=2.0, p=person())
    found = solved(rig, uv, conf)
    assert not found.swapped_hands.any()
    assert not found.left_out.any()
    assert off(found, p, HANDS) < 0.04
    assert off(found, p, FACE) < 0.04


@pytest.mark.parametrize("cameras", [[1], [0, 3], [0, 1, 2, 3]])
def test_swapped_hands_are_put_right(cameras):
    """In one camera, in half of them, and in all, where only the wrists show it."""
    rig, p, uv, conf = seen(ring(), noise=1.0, p=person())
    swapped = np.zeros(conf.shape[:2], bool)
    swapped[cameras, 2:5] = True
    found = solved(rig, swap(uv, swapped), conf)
    np.testing.assert_array_equal(found.swapped_hands, swapped)
    assert not found.swapped.any()
    assert off(found, p, HANDS) < 0.02


def test_a_single_hand_in_the_wrong_place_is_moved():
    rig, p, uv, conf = seen(ring(), noise=1.0, p=person())
    uv[2, 3, RIGHT] = uv[2, 3, LEFT]
    uv[2, 3, LEFT] = np.nan
    found = solved(rig, uv, conf)
    assert np.argwhere(found.swapped_hands).tolist() == [[2, 3]]
    assert not found.left_out.any()
    assert off(found, p, HANDS) < 0.02


def test_a_hand_detected_twice_and_a_strange_one_are_left_out():
    rig, p, uv, conf = seen(ring(), noise=1.0, p=person())
    uv[0, 4, RIGHT] = uv[0, 4, LEFT]
    uv[1, 6, LEFT] += 150
    found = solved(rig, uv, conf)
    assert np.argwhere(found.left_out).tolist() == [[0, 4, 1], [1, 6, 0]]
    assert off(found, p, HANDS) < 0.02
    assert np.isnan(found.error[0, 4, RIGHT]).all()


def test_a_missing_hand_is_missing_and_never_zero():
    rig, p, uv, conf = seen(ring(), noise=1.0, p=person())
    uv[1:, 2:4, LEFT] = np.nan  # one camera is not enough
    uv[:, 5, RIGHT] = np.nan
    found = solved(rig, uv, conf)
    for frames, part in ((slice(2, 4), LEFT), (slice(5, 6), RIGHT)):
        assert np.isnan(found.p[frames, part]).all()
        assert (found.conf[frames, part] == 0).all()
    found.p[2:4, LEFT], found.p[5, RIGHT] = p[2:4, LEFT], p[5, RIGHT]
    assert off(found, p, HANDS) < 0.02


def test_wild_fingers_and_hands_off_the_wrist_are_removed():
    p = person(1).repeat(10, axis=0)
    tip, pip = BODY + FINGERS[1][3], BODY + HAND + FINGERS[2][1]
    p[2, tip] += [0, 0.1, 0]
    p[3, pip] += [0.1, 0, 0]  # both its bones are wrong
    p[5, LEFT] += [0.2, 0, 0]
    p[7, FACE.start] += [0.4, 0, 0]
    found, removed = cleanse(p)
    gone = {(f, j) for f, j in np.argwhere(np.isnan(found[..., 0])).tolist()}
    wrong = {(2, tip), (3, pip), (3, pip + 1), (7, FACE.start)}
    assert gone == wrong | {(5, j) for j in range(LEFT.start, LEFT.stop)}
    assert removed == {"too far away": 1 + HAND, "bone length": 3}
