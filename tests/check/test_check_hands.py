"""Hands that are on the wrong arm, exchanged in one camera, or jitter are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from make import write_face, write_hands

from gsgan.check.hands import hand_findings
from gsgan.check.sections import seen_in
from gsgan.check.settings import Limits
from gsgan.check.views import subject_of
from gsgan.data.crop import project
from gsgan.data.datamodule import GsganData
from gsgan.utils.errors import DataError


@pytest.fixture
def hands(copy: Path) -> tuple[Path, np.ndarray]:
    """The good capture with hands ``[12, 42, 3]``, a millimetre of noise, and their detections."""
    p = write_hands(copy, 12)
    p = p + np.random.default_rng(0).normal(0, 0.001, p.shape)
    write_hands(copy, 12, p=p)
    (copy / "landmarks2d").mkdir()
    for name, camera in subject_of(GsganData(str(copy))).cameras.items():
        found = project(camera, p)[0]
        np.savez(copy / f"landmarks2d/{name}.npz", hands=found, frame_id=np.arange(12))
    return copy, p


def sentences(root: Path) -> list[str]:
    subject = subject_of(GsganData(str(root)))
    return [finding.sentence for finding in hand_findings(subject, Limits())]


def test_good_hands_have_no_finding(hands, good):
    assert sentences(hands[0]) == []
    assert sentences(good) == []  # nor has a capture without


def test_hands_on_the_wrong_arm_are_named_with_their_frames(hands):
    root, p = hands
    p[3:5] = p[3:5].reshape(2, 2, 21, 3)[:, ::-1].reshape(2, 42, 3)
    write_hands(root, 12, p=p)
    found = [text for text in sentences(root) if "lies at" in text]
    assert found == [
        "the left hand lies at the right wrist in 2 of 12 frames: 3-4",
        "the right hand lies at the left wrist in 2 of 12 frames: 3-4",
    ]


def test_a_camera_whose_detections_are_exchanged_is_named(hands):
    root, _ = hands
    path = root / "landmarks2d" / "cam02.npz"
    arrays = dict(np.load(path))
    both = arrays["hands"].reshape(12, 2, 21, 2)
    both[2:9] = both[2:9, ::-1]
    both[5, 0] = np.nan  # in this frame it saw one hand
    both[11] = np.nan
    np.savez(path, **(arrays | {"hands": both.reshape(12, 42, 2)}))
    text = "left and right hand are exchanged in its detections in 7 of 12 frames: 2-8"
    assert sentences(root) == [f"camera cam02: {text}"]


def test_bones_that_change_are_named(hands):
    root, p = hands
    rest = p.copy()
    p[7, 21:] += np.random.default_rng(1).normal(0, 0.03, (21, 3))
    write_hands(root, 12, p=p)
    assert "bones of the right hand are off in 1 of 12 frames: 7" in sentences(root)
    jittery = rest + np.random.default_rng(2).normal(0, 0.01, p.shape)
    write_hands(root, 12, p=jittery)
    assert any("the left hand jitters: its bones change by" in text for text in sentences(root))


def test_missing_hands_are_no_fault(hands):
    root, p = hands
    p[:, :21], p[4:9] = np.nan, np.nan
    write_hands(root, 12, p=p)
    assert sentences(root) == []


def test_damaged_detections_are_named(hands):
    root, _ = hands
    np.savez(root / "landmarks2d/cam01.npz", hands=np.zeros((12, 21, 2)), frame_id=np.arange(12))
    with pytest.raises(DataError, match=r"cam01.npz: 'hands' must have shape \(any, 42, 2\)"):
        sentences(root)


def test_the_report_has_them(hands, check):
    root, p = hands
    write_hands(root, 12, p=p.reshape(12, 2, 21, 3)[:, ::-1].reshape(12, 42, 3))
    texts = [finding.sentence for finding in check(root).findings]
    assert any("the left hand lies at the right wrist in 12 of 12 frames" in t for t in texts)


def test_frames_with_hands_and_with_a_face_are_counted(hands):
    root, p = hands
    write_hands(root, 12, p=np.where(np.arange(12)[:, None, None] < 2, np.nan, p))
    write_face(root, 12, p=write_face(root, 12)[3:], frame_id=np.arange(3, 12))
    layout = GsganData(str(root)).layout
    assert layout.hands is not None
    assert layout.face is not None
    assert [seen_in(part, list(range(12))) for part in (layout.hands, layout.face)] == [10, 9]
