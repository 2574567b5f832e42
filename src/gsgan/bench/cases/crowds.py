"""Hard cases of many Gaussians at once, and of none: number, channels, layers, order."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import torch

from gsgan.bench.cases.case import Case, Inputs, Outputs, Tolerance
from gsgan.bench.cases.raster import (
    HIGH,
    ON_PIXEL,
    SIZE,
    Size,
    cloud,
    gaussians,
    pinhole,
    raster_case,
    render,
    uncut,
)
from gsgan.splat import Accuracy

_case = partial(raster_case, "Gaussians")


def cases() -> Iterator[Case]:
    """All of them."""
    yield _case("none visible", lambda: {**_behind(cloud()), **pinhole()})
    yield _case("N = 0", lambda: {**cloud(0), **pinhole()})
    for channels in (1, 64):
        yield _case(f"C = {channels}", partial(_thirty, channels=channels))
    for size in ((1, 1), (1, 40), (31, 2), (17, 33)):
        yield _case(f"an image of {size[0]} x {size[1]}", partial(_thirty, size=size), size=size)
    yield from _layers()
    yield from _orders()


def _thirty(channels: int = 3, size: Size = SIZE) -> Inputs:
    return {**cloud(30, channels), **pinhole(size)}


def _behind(scene: Inputs) -> Inputs:
    return {**scene, "means": -scene["means"]}


def _layers() -> Iterator[Case]:
    """Thousands of layers, on very small images."""
    # Each layer's rounding counts: 3000 times 6e-8 of what is seen through them all.
    tolerance = Tolerance(2e-5, 5e-4)
    for opacity in (0.01, 0.5):
        scene = partial(_coincident, 3000, opacity, (3, 3))
        name = f"3000 coincident, opacity {opacity:g}"
        yield _case(name, scene, size=(3, 3), tolerance=tolerance)
    for settings in (HIGH, uncut(HIGH)):
        for opacity in (0.01, 0.5):
            yield _case(
                f"5000 layers on a pixel, opacity {opacity:g}, {settings.name}",
                partial(_stacked, 5000, opacity, (2, 3)),
                size=(2, 3),
                settings=settings,
                tolerance=tolerance,
                note="The transmittance underflows; what is hidden has a gradient of nearly 0.",
            )


def _coincident(n: int, opacity: float, size: Size) -> Inputs:
    return {**gaussians([ON_PIXEL] * n, opacity=opacity), **pinhole(size)}


def _stacked(n: int, opacity: float, size: Size) -> Inputs:
    """From 2 to 2.5 m, in random order; far enough apart for float32 to tell their depths."""
    order = torch.randperm(n, generator=torch.Generator().manual_seed(2)).tolist()
    means = [(0.0, 0.0, 2 + 0.5 * i / n) for i in order]
    return {**gaussians(means, opacity=opacity), **pinhole(size)}


def _orders() -> Iterator[Case]:
    row = {**gaussians([(0.05 * i, 0.0, 2.0) for i in range(6)]), **pinhole()}
    yield _case("equal depths, drawn by index", lambda: row)
    yield _case(
        "equal depths, the camera moves by 1e-6 m",
        lambda: row,
        draw=_two_views,
        note="Compared: the change of the image; a flicker would be a change of 0.1 and more.",
    )
    turned = pinhole(axis_angle=(0.3, -0.4, 0.2), t=(0.1, 0.2, 0.3))
    yield _case(
        "a plane across a turned camera, which moves by 1e-6 m",
        lambda: {**_plane(40, turned), **turned},
        draw=_two_views,
        note="Depths differ by rounding only: they must be told apart in float64.",
    )
    # A world whose origin is at the Gaussians: float32 holds 1e-8 m there, not at 2 m.
    close = gaussians([(0.0, 0.0, 1e-8 * (5 - i)) for i in range(6)], scales=(0.2, 0.3, 0.1))
    yield _case(
        "depths nearer than float32 resolves",
        lambda: {**close, **pinhole(t=(0.0, 0.0, 2.0))},
        note="The later one in the list is nearer, by 1e-8 m: depths must be sorted in float64.",
    )


def _plane(n: int, camera: Inputs) -> Inputs:
    """Gaussians on a plane across the camera's axis, their depths equal but for rounding."""
    scene = cloud(n, scale=0.2, extent=(1.6, 1.2, 0.0))
    means = (scene["means"] - camera["t"]) @ camera["R"][0]
    # As float32 holds them, in float64 too: else the order would be that of float64's rounding.
    return {**scene, "means": means.float().double()}


def _two_views(inputs: Inputs, backend: str, *, size: Size, settings: Accuracy) -> Outputs:
    """The image, and how it changes when the camera moves a micrometre."""
    still = render(inputs, backend, size=size, settings=settings)
    change = {}
    for axis, name in enumerate("xyz"):
        step = torch.zeros_like(inputs["t"])
        step[:, axis] = 1e-6
        moved = render({**inputs, "t": inputs["t"] + step}, backend, size=size, settings=settings)
        change[f"change along {name}"] = moved["features"] - still["features"]
    return {**still, **change}
