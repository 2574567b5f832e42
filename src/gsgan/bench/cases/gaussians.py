"""Hard cases of Gaussians: opacity, size, shape, orientation, place; many at once are in crowds.

Each case draws the hard Gaussians among ordinary ones, so that what they do to others counts too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import torch

from gsgan.bench.cases.case import Inputs, Tolerance
from gsgan.bench.cases.crowds import CROWDS
from gsgan.bench.cases.raster import (
    ON_PIXEL,
    Numbers,
    RasterCase,
    among,
    cloud,
    gaussians,
    pinhole,
    raster_case,
    rotation,
    uncut,
)
from gsgan.splat import ACCURACY
from gsgan.splat.project import rotations

HIGH = ACCURACY["high"]


def _among_others(hard: Inputs) -> Callable[[], Inputs]:
    return lambda: {**among(cloud(), hard), **pinhole()}


def _opacities() -> Iterator[RasterCase]:
    opaque = cloud(20, scale=0.3, opacity=(0.95, 1.0))
    for name, settings in (
        ("alphas at the cap", HIGH),
        ("alphas at a cap of 0.9", replace(HIGH, name="capped", alpha_max=0.9)),
        ("alphas at the cap, nothing skipped", uncut(HIGH)),
    ):
        yield raster_case(
            name,
            lambda: {**opaque, **pinhole()},
            settings=settings,
            note="Capped layers get no gradient of opacity and shape, and leave little light.",
        )
    for opacity in (0.0, 1.0):
        yield raster_case(
            f"opacity {opacity:g}",
            _among_others(gaussians([ON_PIXEL], opacity=opacity)),
        )
    yield raster_case(
        "opacity 1 in front of everything",
        _among_others(gaussians([(0.0, 0.0, 0.5)], scales=(5.0, 6.0, 7.0), opacity=1.0)),
        settings=replace(uncut(HIGH), alpha_max=0.99999),
        tolerance=Tolerance(gradients=1e-3),
        note="Nearer to 1 than the presets' cap: float32 keeps three digits of what is behind.",
    )


def _sizes() -> Iterator[RasterCase]:
    for scale in (1e-6, 1e3):
        ratios = torch.tensor([1.0, 1.3, 0.8]) * scale
        yield raster_case(
            f"scales of {scale:g} m",
            _among_others(gaussians([ON_PIXEL], scales=ratios.tolist(), quat=(0.9, 0.3, 0.2, 0.1))),
        )
    yield raster_case(
        "larger than the picture",
        _among_others(gaussians([(0.3, 0.2, 3.0)], scales=(10.0, 14.0, 8.0), opacity=0.5)),
    )
    yield raster_case("far below a pixel", lambda: {**cloud(200, scale=1e-4), **pinhole()})
    yield raster_case(
        "below a pixel, anti-aliased",
        lambda: {**cloud(200, scale=3e-3), **pinhole()},
        settings=replace(HIGH, antialias=True),
    )
    yield raster_case(
        "1e-6 m, anti-aliased",
        _among_others(gaussians([ON_PIXEL], scales=(1e-6, 2e-6, 3e-6), quat=(0.9, 0.3, 0.2, 0.1))),
        settings=replace(uncut(HIGH), antialias=True),
        note="Nothing is skipped: what is left of its opacity is far below any cut-off.",
    )


def _needles() -> Iterator[RasterCase]:
    """1e4 : 1, about 300 pixels long, turned in the picture."""
    camera = pinhole(focal=600.0)
    note = "Hundreds of pixels long and half a pixel wide, low-pass included."
    for degrees in (0.0, 45.0, 90.0, 37.3, 0.05):
        half = math.radians(degrees) / 2
        quat = (math.cos(half), 0.0, 0.0, math.sin(half))
        yield raster_case(
            f"needle 1e4:1 at {degrees:g} degrees",
            _sparse([(0.01, 0.004, 2.0)], (1.0, 1e-4, 1e-4), quat, camera),
            note=note,
        )
    half = math.radians(45) / 2
    quat = (math.cos(half), 0.0, 0.0, math.sin(half))
    yield raster_case(
        "needle through the picture, its mean 300 px outside",
        _sparse([(0.72, 0.7, 2.0)], (1.0, 1e-4, 1e-4), quat, camera),
        tolerance=Tolerance(2e-5, 3e-4),
        note="The reference rounds the mean to float32, 3e-5 px; the others round differences.",
    )
    yield raster_case(
        "needle 1e4:1 on the picture itself, 6000 px long",
        _sparse([(0.01, 0.004, 2.0)], (20.0, 2e-3, 2e-3), quat, camera),
        note=note,
    )
    yield raster_case(
        "needle towards the camera",
        _sparse([(0.01, 0.004, 2.0)], (1e-4, 1e-4, 1.0), (1.0, 0.0, 0.0, 0.0), camera),
    )
    yield raster_case(
        "needle, anti-aliased",
        _sparse([(0.01, 0.004, 2.0)], (1.0, 1e-4, 1e-4), quat, camera),
        settings=replace(HIGH, antialias=True),
        note=note,
    )
    for name, turn in (("seen flat", 0.0), ("seen edge on", math.pi / 4), ("tilted", 0.6)):
        yield raster_case(
            f"pancake 1e4:1 {name}",
            _sparse(
                [(0.01, 0.004, 2.0)],
                (1.0, 1.0, 1e-4),
                (math.cos(turn), 0.0, math.sin(turn), 0.0),
                camera,
            ),
        )


def _low_passes() -> Iterator[RasterCase]:
    """What is thinner than a pixel, at the low-pass of conf/model: a quarter of the usual one."""
    camera, settings = pinhole(focal=600.0), replace(HIGH, name="of the model", low_pass=0.0833)
    name = "low-pass of 1/12, {}"
    for degrees, antialias in ((0.0, False), (45.0, False), (37.3, False), (45.0, True)):
        half = math.radians(degrees) / 2
        yield raster_case(
            name.format(f"needle at {degrees:g} degrees{', anti-aliased' if antialias else ''}"),
            _sparse(
                [(0.01, 0.004, 2.0)],
                (1.0, 1e-4, 1e-4),
                (math.cos(half), 0.0, 0.0, math.sin(half)),
                camera,
            ),
            settings=replace(settings, antialias=antialias),
        )
    yield raster_case(
        name.format("pancake seen edge on"),
        _sparse(
            [(0.01, 0.004, 2.0)],
            (1.0, 1.0, 1e-4),
            (math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 0.0),
            camera,
        ),
        settings=settings,
    )
    for times in (2, 3):
        yield raster_case(
            name.format(f"needle drawn {times} times as large and averaged"),
            _sparse([(0.01, 0.004, 2.0)], (1.0, 1e-4, 1e-4), (0.9, 0.0, 0.0, 0.3), camera),
            settings=replace(settings, supersample=times),
        )
    for shape, diagonal in (("of rank 1", (0.04, 0.0, 0.0)), ("zero", (0.0, 0.0, 0.0))):
        yield raster_case(
            name.format(f"covariance {shape}"),
            partial(_with_covariance, diagonal),
            settings=settings,
        )
    yield raster_case(
        name.format("200 far below a pixel"),
        lambda: {**cloud(200, scale=1e-4), **pinhole()},
        settings=settings,
        tolerance=Tolerance(4e-5, 4e-4),
        note="A spot a third of a pixel wide: rounding its mean counts four times as much as at "
        "the usual low-pass.",
    )


def _sparse(
    means: list[Numbers], scales: Numbers, quat: Numbers, camera: Inputs
) -> Callable[[], Inputs]:
    """Hard Gaussians among small ordinary ones, through a long lens."""
    others = cloud(8, scale=0.006, extent=(0.1, 0.08, 0.1), middle=(0.0, 0.0, 2.1))
    return lambda: {**among(others, gaussians(means, scales=scales, quat=quat)), **camera}


def _covariances() -> Iterator[RasterCase]:
    """Shapes that LBS blends can give and no rotation and scales describe."""
    for name, diagonal in (
        ("of rank 2", (0.01, 0.02, 0.0)),
        ("of rank 1", (0.04, 0.0, 0.0)),
        ("zero", (0.0, 0.0, 0.0)),
    ):
        yield raster_case(f"covariance {name}", partial(_with_covariance, diagonal))


def _with_covariance(diagonal: Numbers) -> Inputs:
    scene = {**among(_as_covariances(cloud()), _as_covariances(gaussians([ON_PIXEL]))), **pinhole()}
    R = rotation((0.8, 0.4, 0.3))
    flat = R @ torch.diag(torch.tensor(diagonal, dtype=torch.float64)) @ R.mT
    return {**scene, "covariances": flat.expand(1, 1, 3, 3)}


def _as_covariances(scene: Inputs) -> Inputs:
    M = rotations(scene["quats"]) * scene["scales"].unsqueeze(-2)
    kept = {name: scene[name] for name in ("means", "opacities", "features")}
    return {**kept, "covariances": M @ M.mT}


def _quaternions() -> Iterator[RasterCase]:
    shape = (0.1, 0.2, 0.3)
    for name, length in (("tiny", 1e-15), ("huge", 1e15), ("of length 3", 3.0)):
        direction = torch.tensor([0.8, 0.4, 0.3, 0.2]) / math.sqrt(0.93) * length
        yield raster_case(
            f"quaternion {name}",
            _among_others(gaussians([ON_PIXEL], scales=shape, quat=direction.tolist())),
        )
    for name, length in (("zero", 0.0), ("1e-30", 1e-30)):
        yield raster_case(
            f"quaternion {name}",
            _among_others(gaussians([ON_PIXEL], scales=shape, quat=(0.0, length, 0.0, 0.0))),
            note="Noise, not a direction: drawn as the identity, and it gets no gradient.",
        )


def _places() -> Iterator[RasterCase]:
    small = (0.011, 0.009, 0.01)
    for name, mean, scales in (
        ("just past the near plane", (0.001, 0.0005, 0.0101), small),
        ("just before the near plane", (0.001, 0.0005, 0.0099), small),
        ("on the near plane", (0.001, 0.0005, 0.01), small),
        ("behind the camera", (0.1, 0.2, -2.0), (0.1, 0.2, 0.3)),
        ("at z = 0", (0.3, 0.2, 0.0), (0.1, 0.2, 0.3)),
        ("at the camera's centre", (0.0, 0.0, 0.0), (0.1, 0.2, 0.3)),
        ("at z = 1e-30", (0.3, 0.2, 1e-30), (0.1, 0.2, 0.3)),
        ("far off-axis", (1e6, 1e5, 1.0), (0.1, 0.2, 0.3)),
        ("off-axis and close, reaching into the picture", (3.0, 0.5, 0.2), (1.0, 1.2, 0.8)),
        ("off-axis, past the near plane, metres wide", (0.5, 0.2, 0.0101), (1.0, 1.2, 0.8)),
        ("1e6 m away", (1e5, -1e5, 1e6), (1e4, 2e4, 3e4)),
    ):
        yield raster_case(f"mean {name}", _among_others(gaussians([mean], scales=scales)))


GAUSSIANS: tuple[RasterCase, ...] = (
    *_opacities(),
    *_sizes(),
    *_needles(),
    *_covariances(),
    *_low_passes(),
    *_quaternions(),
    *_places(),
    *CROWDS,
)
