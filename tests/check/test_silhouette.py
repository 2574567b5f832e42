"""The estimated silhouette against values known in advance."""

import numpy as np

from gsgan.check.views import body_silhouette
from gsgan.data.cameras import CameraEntry
from gsgan.skeleton.template import MEDIAPIPE33


def silhouette(pixels, depth=2.0, visible=None, size=(200, 120), focal=200.0):
    visible = np.ones(33, bool) if visible is None else visible
    camera = CameraEntry(
        "a",
        np.diag([focal, focal, 1]),
        np.eye(3),
        np.zeros(3),
        np.zeros(8),
        size,
    )
    p = np.concatenate([pixels / focal, np.ones((33, 1))], 1) * depth
    return body_silhouette(camera, p, visible, MEDIAPIPE33)


def standing() -> np.ndarray:
    rest = np.array(MEDIAPIPE33.rest_positions)
    return np.stack([60 + 100 * rest[:, 0], 190 - 100 * rest[:, 1]], 1)


def test_the_estimated_silhouette_covers_its_joints_and_no_more_than_a_body():
    pixels = standing()
    body = silhouette(pixels)
    assert body[
        np.floor(pixels[:, 1]).astype(int), np.floor(pixels[:, 0]).astype(int)
    ].all()
    area = body.sum() / 100**2  # square metres
    assert 0.35 < area < 0.75
    assert body[80, 60]  # the trunk is filled
