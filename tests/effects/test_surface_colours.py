"""Colours on shared surface: tints are seen, sides lit differently are not taken for them."""

import numpy as np
import pytest
import torch

from gsgan.data.surface_colours import surface_colours
from gsgan.scene import Camera, Frame

SIZE, RADIUS = 96, 0.5


def ball(
    angle: float, moment: int, *, gain=(1.0, 1.0, 1.0), gloss: float = 0.0
) -> Frame:
    """A ball of half a metre, lit from +x and textured, seen from 2.5 m away.

    gloss: brightness of a highlight round the direction to the camera (a light beside it).
    """
    forward = np.array([-np.cos(angle), -np.sin(angle), 0.0])
    right, down = np.cross(forward, [0, 0, 1.0]), np.array([0, 0, -1.0])
    R = np.stack([right, down, forward])
    centre = -2.5 * forward
    K = np.array([[160.0, 0, SIZE / 2], [0, 160.0, SIZE / 2], [0, 0, 1]])
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = (
        np.stack(
            [(u - SIZE / 2) / 160, (v - SIZE / 2) / 160, np.ones_like(u)], -1
        )
        @ R
    )
    a, b = (rays**2).sum(-1), rays @ centre
    root = b**2 - a * (centre @ centre - RADIUS**2)
    hit = root > 0
    normal = (
        centre + rays * ((-b - np.sqrt(np.maximum(root, 0))) / a)[..., None]
    ) / RADIUS
    light = 0.3 + 0.4 * np.clip(normal[..., 0], 0, 1)
    texture = 1 + 0.1 * np.sin(4 * normal[..., 2] + moment)
    colour = (
        (light * texture)[..., None]
        * np.array([1.0, 0.8, 0.7])
        * np.array(gain)
    )
    towards = np.clip(-(normal @ forward), 0, 1)
    colour += gloss * (towards[..., None] ** 30)
    image = np.where(hit[..., None], colour, 0).clip(0, 1)
    joints = (
        RADIUS
        * 0.5
        * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]])
    )
    tensor = {
        name: torch.tensor(value, dtype=torch.float32)[None]
        for name, value in {
            "K": K,
            "R": R,
            "t": -R @ centre,
            "p": joints,
        }.items()
    }
    return Frame(
        image=torch.tensor(image, dtype=torch.float32).permute(2, 0, 1)[None],
        mask=torch.tensor(hit, dtype=torch.float32)[None, None],
        camera=Camera(tensor["K"], tensor["R"], tensor["t"], (SIZE, SIZE)),
        skeleton=tensor["p"],
        visibility=torch.ones(1, 5),
        frame_id=torch.tensor([moment]),
        camera_index=torch.tensor([0]),
    )


def moments(
    angles=(0.0, 0.8, 1.6), count: int = 3, tint=None, **options
) -> list[list[Frame]]:
    gains = tint or [(1.0, 1.0, 1.0)] * len(angles)
    return [
        [
            ball(a, m, gain=g, **options)
            for a, g in zip(angles, gains, strict=True)
        ]
        for m in range(count)
    ]


def test_light_from_one_side_is_no_tint():
    frames = moments()
    means = [float(f.image.sum() / f.mask.sum()) for f in frames[0]]
    assert (
        max(means) - min(means) > 0.3
    )  # what a mean over the person would fall for
    seen = surface_colours(frames)
    assert seen.difference < 0.02
    assert seen.residual < 0.05


def test_a_tint_is_measured():
    tint = [(1.0, 1.0, 1.0), (1.0, 1.0, 0.8), (1.0, 1.0, 1.0)]
    seen = surface_colours(moments(tint=tint))
    # blue 0.7 x light, a fifth less of it: light on shared surface is 0.3 to 0.7
    assert 0.04 < seen.difference < 0.1


def test_highlights_are_what_is_left():
    matt, glossy = (surface_colours(moments(gloss=g)) for g in (0.0, 0.5))
    assert glossy.residual > 2 * matt.residual


@pytest.mark.parametrize(
    "damage", ["far apart", "coarse", "few moments", "empty masks", "astray"]
)
def test_without_shared_surface_nothing_is_claimed(damage):
    from dataclasses import replace

    frames = (
        moments(angles=(0.0, np.pi)) if damage == "far apart" else moments()
    )
    if damage == "coarse":
        frames = [
            [
                replace(f, camera=replace(f.camera, K=f.camera.K * 0.3))
                for f in m
            ]
            for m in frames
        ]
    if damage == "few moments":
        frames = frames[:2]
    if damage == "empty masks":
        frames = [
            [replace(f, mask=f.mask * 0, image=f.image * 0) for f in m]
            for m in frames
        ]
    # a joint 1 km off: carving so wide a box would take all memory
    if damage == "astray":
        joints = frames[0][0].skeleton.clone()
        joints[0, 0, 0] = 1000.0
        frames = [[replace(f, skeleton=joints) for f in m] for m in frames]
    assert surface_colours(frames) is None
