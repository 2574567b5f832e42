"""Hard Gaussians: opacity, size, shape, orientation, place, number, layers, order.

Each case renders the hard Gaussians among ordinary ones, so that their effect on others counts too.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from gsgan.splat import Accuracy
from gsgan.splat.project import rotations
from stability.cases.case import Case, Inputs, Outputs, Tolerance
from stability.cases.raster import (
    HIGH,
    ON_PIXEL,
    SIZE,
    Numbers,
    Size,
    among,
    cloud,
    gaussians,
    pinhole,
    raster_case,
    render,
    rotation,
    uncut,
)

NEEDLE, PANCAKE = (1.0, 1e-4, 1e-4), (1.0, 1.0, 1e-4)  # metres; two metres away
AHEAD = (0.01, 0.004, 2.0)
TILTED = (0.9, 0.3, 0.2, 0.1)  # a quaternion
EDGE_ON = (math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 0.0)

_case = partial(raster_case, "Gaussians")


def cases() -> Iterator[Case]:
    """All of them."""
    yield from _opacities()
    yield from _sizes()
    yield from _needles()
    for shape, diagonal in (("of rank 2", (0.01, 0.02, 0.0)), *FLAT):
        yield _case(f"covariance {shape}", partial(_with_covariance, diagonal))
    yield from _low_passes()
    yield from _quaternions()
    yield from _places()
    yield _case("none visible", lambda: {**_behind(cloud()), **pinhole()})
    yield _case("N = 0", lambda: {**cloud(0), **pinhole()})
    for channels in (1, 64):
        yield _case(f"C = {channels}", partial(_thirty, channels=channels))
    for size in ((1, 1), (1, 40), (31, 2), (17, 33)):
        yield _case(
            f"an image of {size[0]} x {size[1]}",
            partial(_thirty, size=size),
            size=size,
        )
    yield from _layers()
    yield from _orders()


def _alone(
    name: str, mean: Numbers = ON_PIXEL, options: Any = None, **shape: Any
) -> Case:
    """One hard Gaussian among a dozen ordinary ones."""
    return _case(
        name,
        lambda: {**among(cloud(), gaussians([mean], **shape)), **pinhole()},
        **(options or {}),
    )


def _opacities() -> Iterator[Case]:
    opaque = {**cloud(20, scale=0.3, opacity=(0.95, 1.0)), **pinhole()}
    for name, settings in (
        ("alphas at the cap", HIGH),
        ("alphas at a cap of 0.9", replace(HIGH, name="capped", alpha_max=0.9)),
        ("alphas at the cap, nothing skipped", uncut(HIGH)),
    ):
        note = "Capped layers get no gradient of opacity and shape, and let little light through."
        yield _case(name, lambda: opaque, settings=settings, note=note)
    for opacity in (0.0, 1.0):
        yield _alone(f"opacity {opacity:g}", opacity=opacity)
    options = {
        "settings": replace(uncut(HIGH), alpha_max=0.99999),
        "tolerance": Tolerance(gradients=1e-3),
        "note": "Nearer to 1 than the presets' cap: float32 keeps three digits of what is behind.",
    }
    front, wide = (0.0, 0.0, 0.5), (5.0, 6.0, 7.0)
    yield _alone(
        "opacity 1 in front of everything",
        front,
        options,
        scales=wide,
        opacity=1.0,
    )


def _sizes() -> Iterator[Case]:
    for scale in (1e-6, 1e3):
        scales = (torch.tensor([1.0, 1.3, 0.8]) * scale).tolist()
        yield _alone(f"scales of {scale:g} m", scales=scales, quat=TILTED)
    large = {"scales": (10.0, 14.0, 8.0), "opacity": 0.5}
    yield _alone("larger than the image", (0.3, 0.2, 3.0), **large)
    yield _case(
        "far below a pixel", lambda: {**cloud(200, scale=1e-4), **pinhole()}
    )
    yield _case(
        "below a pixel, anti-aliased",
        lambda: {**cloud(200, scale=3e-3), **pinhole()},
        settings=replace(HIGH, antialias=True),
    )
    options = {
        "settings": replace(uncut(HIGH), antialias=True),
        "note": "Nothing is skipped: what is left of its opacity is far below any cut-off.",
    }
    yield _alone(
        "1e-6 m, anti-aliased",
        options=options,
        scales=(1e-6, 2e-6, 3e-6),
        quat=TILTED,
    )


def _sparse(
    name: str,
    scales: Numbers,
    quat: Numbers,
    mean: Numbers = AHEAD,
    **options: Any,
) -> Case:
    """One hard Gaussian among small ordinary ones, through a long lens."""
    others = cloud(
        8, scale=0.006, extent=(0.1, 0.08, 0.1), middle=(0.0, 0.0, 2.1)
    )
    hard = gaussians([mean], scales=scales, quat=quat)
    return _case(
        name, lambda: {**among(others, hard), **pinhole(focal=600.0)}, **options
    )


def _turned(degrees: float) -> Numbers:
    """The quaternion of a turn in the image."""
    half = math.radians(degrees) / 2
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def _needles() -> Iterator[Case]:
    """1e4 : 1, about 300 pixels long, turned in the image."""
    note = "Hundreds of pixels long and half a pixel wide, low-pass included."
    for degrees in (0.0, 45.0, 90.0, 37.3, 0.05):
        name = f"needle 1e4:1 at {degrees:g} degrees"
        yield _sparse(name, NEEDLE, _turned(degrees), note=note)
    yield _sparse(
        "needle through the image, its mean 300 px outside",
        NEEDLE,
        _turned(45),
        (0.72, 0.7, 2.0),
        tolerance=Tolerance(2e-5, 3e-4),
        note="The reference rounds the mean to float32, 3e-5 px; the others round differences.",
    )
    long = "needle 1e4:1 on the image itself, 6000 px long"
    yield _sparse(long, (20.0, 2e-3, 2e-3), _turned(45), note=note)
    yield _sparse(
        "needle towards the camera", (1e-4, 1e-4, 1.0), (1.0, 0.0, 0.0, 0.0)
    )
    settings = replace(HIGH, antialias=True)
    yield _sparse(
        "needle, anti-aliased",
        NEEDLE,
        _turned(45),
        settings=settings,
        note=note,
    )
    for name, turn in (
        ("seen flat", 0.0),
        ("seen edge on", math.pi / 4),
        ("tilted", 0.6),
    ):
        quat = (math.cos(turn), 0.0, math.sin(turn), 0.0)
        yield _sparse(f"pancake 1e4:1 {name}", PANCAKE, quat)


def _low_passes() -> Iterator[Case]:
    """What is thinner than a pixel, at the low-pass of conf/model: a quarter of the usual one."""
    settings, name = (
        replace(HIGH, name="of the model", low_pass=0.0833),
        "low-pass of 1/12, ",
    )
    for degrees, antialias in (
        (0.0, False),
        (45.0, False),
        (37.3, False),
        (45.0, True),
    ):
        yield _sparse(
            f"{name}needle at {degrees:g} degrees{', anti-aliased' if antialias else ''}",
            NEEDLE,
            _turned(degrees),
            settings=replace(settings, antialias=antialias),
        )
    yield _sparse(
        f"{name}pancake seen edge on", PANCAKE, EDGE_ON, settings=settings
    )
    for times in (2, 3):
        yield _sparse(
            f"{name}needle drawn {times} times as large and averaged",
            NEEDLE,
            (0.9, 0.0, 0.0, 0.3),
            settings=replace(settings, supersample=times),
        )
    for shape, diagonal in FLAT:
        scene = partial(_with_covariance, diagonal)
        yield _case(f"{name}covariance {shape}", scene, settings=settings)
    yield _case(
        f"{name}200 far below a pixel",
        lambda: {**cloud(200, scale=1e-4), **pinhole()},
        settings=settings,
        tolerance=Tolerance(4e-5, 4e-4),
        note="A spot a third of a pixel wide: rounding its mean counts four times as much as at "
        "the usual low-pass.",
    )


# Diagonals of covariances that LBS blends can give and no rotation and scales describe.
FLAT = (("of rank 1", (0.04, 0.0, 0.0)), ("zero", (0.0, 0.0, 0.0)))


def _with_covariance(diagonal: Numbers) -> Inputs:
    scene = {
        **among(
            _as_covariances(cloud()), _as_covariances(gaussians([ON_PIXEL]))
        ),
        **pinhole(),
    }
    R = rotation((0.8, 0.4, 0.3))
    flat = R @ torch.diag(torch.tensor(diagonal, dtype=torch.float64)) @ R.mT
    return {**scene, "covariances": flat.expand(1, 1, 3, 3)}


def _as_covariances(scene: Inputs) -> Inputs:
    M = rotations(scene["quats"]) * scene["scales"].unsqueeze(-2)
    kept = {name: scene[name] for name in ("means", "opacities", "features")}
    return {**kept, "covariances": M @ M.mT}


def _quaternions() -> Iterator[Case]:
    shape = (0.1, 0.2, 0.3)
    for name, length in (("tiny", 1e-15), ("huge", 1e15), ("of length 3", 3.0)):
        direction = (
            torch.tensor([0.8, 0.4, 0.3, 0.2]) / math.sqrt(0.93) * length
        )
        yield _alone(
            f"quaternion {name}", scales=shape, quat=direction.tolist()
        )
    options = {
        "note": "Noise, not a direction: drawn as the identity, and it gets no gradient."
    }
    for name, length in (("zero", 0.0), ("1e-30", 1e-30)):
        quat = (0.0, length, 0.0, 0.0)
        yield _alone(
            f"quaternion {name}", options=options, scales=shape, quat=quat
        )


def _places() -> Iterator[Case]:
    small, usual, metres = (
        (0.011, 0.009, 0.01),
        (0.1, 0.2, 0.3),
        (1.0, 1.2, 0.8),
    )
    for name, mean, scales in (
        ("just past the near plane", (0.001, 0.0005, 0.0101), small),
        ("just before the near plane", (0.001, 0.0005, 0.0099), small),
        ("on the near plane", (0.001, 0.0005, 0.01), small),
        ("behind the camera", (0.1, 0.2, -2.0), usual),
        ("at z = 0", (0.3, 0.2, 0.0), usual),
        ("at the camera's centre", (0.0, 0.0, 0.0), usual),
        ("at z = 1e-30", (0.3, 0.2, 1e-30), usual),
        ("far off-axis", (1e6, 1e5, 1.0), usual),
        (
            "off-axis and close, reaching into the image",
            (3.0, 0.5, 0.2),
            metres,
        ),
        (
            "off-axis, past the near plane, metres wide",
            (0.5, 0.2, 0.0101),
            metres,
        ),
        ("1e6 m away", (1e5, -1e5, 1e6), (1e4, 2e4, 3e4)),
    ):
        yield _alone(f"mean {name}", mean, scales=scales)


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
    order = torch.randperm(
        n, generator=torch.Generator().manual_seed(2)
    ).tolist()
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
    close = gaussians(
        [(0.0, 0.0, 1e-8 * (5 - i)) for i in range(6)], scales=(0.2, 0.3, 0.1)
    )
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


def _two_views(
    inputs: Inputs, backend: str, *, size: Size, settings: Accuracy
) -> Outputs:
    """The image, and how it changes when the camera moves a micrometre."""
    still = render(inputs, backend, size=size, settings=settings)
    change = {}
    for axis, name in enumerate("xyz"):
        step = torch.zeros_like(inputs["t"])
        step[:, axis] = 1e-6
        moved = render(
            {**inputs, "t": inputs["t"] + step},
            backend,
            size=size,
            settings=settings,
        )
        change[f"change along {name}"] = moved["features"] - still["features"]
    return {**still, **change}
