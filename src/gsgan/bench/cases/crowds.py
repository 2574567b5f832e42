"""Hard cases of many Gaussians at once, and of none: number, channels, layers, order."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import torch

from gsgan.bench.cases.case import Inputs, Outputs, Tolerance
from gsgan.bench.cases.raster import (
    ON_PIXEL,
    SIZE,
    RasterCase,
    Size,
    cloud,
    gaussians,
    picture,
    pinhole,
    raster_case,
    uncut,
)
from gsgan.splat import ACCURACY, Accuracy

HIGH = ACCURACY["high"]


def _numbers() -> Iterator[RasterCase]:
    yield raster_case("none visible", lambda: {**_behind(cloud()), **pinhole()})
    yield raster_case("N = 0", lambda: {**cloud(0), **pinhole()})
    for channels in (1, 64):
        yield raster_case(f"C = {channels}", partial(_thirty, channels=channels))
    for size in ((1, 1), (1, 40), (31, 2), (17, 33)):
        yield raster_case(
            f"a picture of {size[0]} x {size[1]}",
            partial(_thirty, size=size),
            size=size,
        )


def _thirty(channels: int = 3, size: Size = SIZE) -> Inputs:
    return {**cloud(30, channels), **pinhole(size)}


def _behind(scene: Inputs) -> Inputs:
    return {**scene, "means": -scene["means"]}


_THOUSANDS = Tolerance(2e-5, 5e-4)
"""Each layer's rounding counts: 3000 times 6e-8 of what is seen through them all."""


def _many() -> Iterator[RasterCase]:
    """Thousands of layers; on very small pictures."""
    for opacity in (0.01, 0.5):
        yield raster_case(
            f"3000 coincident, opacity {opacity:g}",
            partial(_coincident, 3000, opacity, (3, 3)),
            size=(3, 3),
            tolerance=_THOUSANDS,
        )
    for settings in (HIGH, uncut(HIGH)):
        for opacity in (0.01, 0.5):
            yield raster_case(
                f"5000 layers on a pixel, opacity {opacity:g}, {settings.name}",
                partial(_layers, 5000, opacity, (2, 3)),
                size=(2, 3),
                settings=settings,
                tolerance=_THOUSANDS,
                note="The transmittance underflows; what is hidden has a gradient of nearly 0.",
            )


def _coincident(n: int, opacity: float, size: Size) -> Inputs:
    return {**gaussians([ON_PIXEL] * n, opacity=opacity), **pinhole(size)}


def _layers(n: int, opacity: float, size: Size) -> Inputs:
    """From 2 to 2.5 m, in no order; far enough apart for float32 to tell their depths."""
    order = torch.randperm(n, generator=torch.Generator().manual_seed(2)).tolist()
    means = [(0.0, 0.0, 2 + 0.5 * i / n) for i in order]
    return {**gaussians(means, opacity=opacity), **pinhole(size)}


def _orders() -> Iterator[RasterCase]:
    yield raster_case(
        "equal depths, drawn by index",
        lambda: {**gaussians([(0.05 * i, 0.0, 2.0) for i in range(6)]), **pinhole()},
    )
    yield raster_case(
        "equal depths, the camera moves by 1e-6 m",
        lambda: {**gaussians([(0.05 * i, 0.0, 2.0) for i in range(6)]), **pinhole()},
        draw=_two_views,
        note="Judged: the change of the picture; a flicker would be a change of 0.1 and more.",
    )
    yield raster_case(
        "a plane across a turned camera, which moves by 1e-6 m",
        lambda: {**_plane(40), **pinhole(axis_angle=(0.3, -0.4, 0.2), t=(0.1, 0.2, 0.3))},
        draw=_two_views,
        note="Depths differ by rounding only: they are to be told apart in float64.",
    )
    yield raster_case(
        "depths nearer than float32 resolves",
        lambda: {**_close_depths(), **pinhole(t=(0.0, 0.0, 2.0))},
        note="The later one in the list is nearer, by 1e-8 m: depths are to be sorted in float64.",
    )


def _plane(n: int) -> Inputs:
    """Gaussians on a plane across the turned camera's axis, their depths equal but for rounding."""
    camera = pinhole(axis_angle=(0.3, -0.4, 0.2), t=(0.1, 0.2, 0.3))
    scene = cloud(n, scale=0.2, extent=(1.6, 1.2, 0.0))
    means = (scene["means"] - camera["t"]) @ camera["R"][0]
    # As float32 holds them, in float64 too: else the order would be that of float64's rounding.
    return {**scene, "means": means.float().double()}


def _close_depths() -> Inputs:
    """A world whose origin is at the Gaussians: float32 holds 1e-8 m there, not at 2 m."""
    means = [(0.0, 0.0, 1e-8 * (5 - i)) for i in range(6)]
    return gaussians(means, scales=(0.2, 0.3, 0.1))


def _two_views(inputs: Inputs, backend: str, *, size: Size, settings: Accuracy) -> Outputs:
    """The picture, and how it changes when the camera moves a micrometre."""
    still = picture(inputs, backend, size=size, settings=settings)
    change = {}
    for axis, name in enumerate("xyz"):
        step = torch.zeros_like(inputs["t"])
        step[:, axis] = 1e-6
        moved = picture({**inputs, "t": inputs["t"] + step}, backend, size=size, settings=settings)
        change[f"change along {name}"] = moved["features"] - still["features"]
    return {**still, **change}


CROWDS: tuple[RasterCase, ...] = (*_numbers(), *_many(), *_orders())
