"""Hard residuals of Ψ: saturated, overflowing, cancelling."""

import math
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from gsgan.model.deformation import Deformation
from gsgan.model.residual_gaussians import Residuals
from gsgan.scene import Camera
from gsgan.skeleton import MEDIAPIPE33, Densify
from gsgan.splat import Accuracy
from stability.cases.case import FINITE_ONLY, Case, Inputs, Tolerance
from stability.cases.poses import noisy, rest
from stability.cases.raster import Numbers, Size, pinhole, raster_case, rendered

SH_DEGREE, FEATURES = 1, 2
NAMES = tuple(field.name for field in fields(Residuals))


@lru_cache(maxsize=8)
def some_points(dtype: torch.dtype, device: torch.device) -> Densify:
    """Densify with so many points that none starts wider than Ψ allows."""
    return Densify(
        points_per_limb=40, face_points=60, torso_points=80, dtype=dtype
    ).to(device)


@lru_cache(maxsize=8)
def small_psi(dtype: torch.dtype, device: torch.device) -> Deformation:
    """A Ψ of few points, as it is built: its last layer zero."""
    points = some_points(dtype, device)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        psi = Deformation(
            points.rest_points,
            MEDIAPIPE33.stature,
            width=16,
            layers=2,
            embedding=4,
            features=FEATURES,
            sh_degree=SH_DEGREE,
            normals=True,
        )
    return psi.to(device, dtype)


def ordinary_residuals(seed: int = 0, sigma: float = 0.3) -> Inputs:
    """Random residuals, the pose they belong to, and where they are seen from."""
    n = some_points(torch.float64, torch.device("cpu")).n_points
    generator = torch.Generator().manual_seed(seed)
    sh = ((SH_DEGREE + 1) ** 2, 3)
    shapes = {
        "means": (3,),
        "quats": (4,),
        "scales": (3,),
        "opacities": (),
        "sh": sh,
    }
    made = {
        name: sigma
        * torch.randn(1, n, *shape, generator=generator, dtype=torch.float64)
        for name, shape in {**shapes, "features": (FEATURES,)}.items()
    }
    return {
        **made,
        "p": noisy(1),
        "eye": torch.tensor([[0.1, 1.0, 4.0]], dtype=torch.float64),
    }


def composed(inputs: Inputs, frame: Numbers | None = None) -> dict[str, Tensor]:
    """Ĝ of given residuals; ``frame``: nine numbers for every point in place of its part's."""
    p = inputs["p"]
    points = some_points(p.dtype, p.device)(p)
    if frame is not None:
        frames = (
            p.new_tensor(frame).view(1, 1, 3, 3).expand_as(points.rotations)
        )
        points = replace(points, rotations=frames)
    residuals = Residuals(**{name: inputs[name] for name in NAMES})
    made = small_psi(p.dtype, p.device).compose(
        points, residuals, inputs["eye"]
    )
    return {
        "means": made.means,
        # in square centimetres, so that an error counts against the size of a Gaussian
        "covariances": made.covariances * 1e4,
        "opacities": made.opacities,
        "features": made.features,
    }


def _changed(**changes: float | Tensor) -> Inputs:
    """Ordinary residuals but for the given ones."""
    made = ordinary_residuals()
    for key, value in changes.items():
        made[key] = (
            torch.as_tensor(value, dtype=torch.float64)
            .expand_as(made[key])
            .clone()
        )
    return made


def cases() -> Iterator[Case]:
    """All of them."""
    for name, note, options, changes in (
        *_residuals(),
        *_quaternions(),
        _close_camera(),
    ):
        yield Case(
            "Ψ",
            name,
            partial(_changed, **changes),
            composed,
            note=note,
            **options,
        )
    for name, (frame, note) in FRAMES.items():
        run = partial(composed, frame=frame)
        yield Case("Ψ", f"frames of {name}", ordinary_residuals, run, note=note)
    camera = pinhole(focal=20.0, axis_angle=(math.pi, 0, 0), t=(0.0, 0.85, 2.6))
    for name, p in (("the rest pose", rest()), ("an ordinary pose", noisy(5))):
        yield raster_case(
            "Ψ",
            f"step 0 on {name}",
            partial(dict, p=p, **camera),
            draw=_step_zero,
            note="Exactly densify's Gaussians, grey and half transparent; only limbs shorter than "
            "5 mm start wider, at the least scale.",
        )


# name, note, options of the case, changes
Row = tuple[str, str, dict[str, Any], dict[str, Any]]


def _residuals() -> Iterator[Row]:
    round_ones = {
        "gradient_floor": {"quats": 1e-3},
        "tolerance": Tolerance(gradients=1e-3),
    }
    same = "The Gaussians are round, so turning them makes no difference."
    yield "ordinary residuals", "", {}, {}
    yield "means' tanh at 4", "Its slope is 1e-3.", {}, {"means": 4.0}
    note = "Its slope, 4e-7, is a difference of near-equal numbers: float32 has one digit of it."
    yield "means' tanh at 8", note, {"expect": FINITE_ONLY}, {"means": 8.0}
    for value in (1e3, -1e3):
        note = "The mean stays a quarter of a body height away; the slope is 0."
        yield f"means' tanh saturated at {value:g}", note, {}, {"means": value}
        note = f"Clamped before the exponential: nothing overflows, the slope is 0. {same}"
        yield (
            f"scales' exponent at {value:g}",
            note,
            round_ones,
            {"scales": value},
        )
        note = "Clamped to ± 8, where the sigmoid is off 0 and 1; the slope beyond is 0."
        yield f"opacity's logit at {value:g}", note, {}, {"opacities": value}
        yield (
            f"colour at {value:g}",
            "At least 0, not bounded above.",
            {},
            {"sh": value},
        )
        yield (
            f"every residual at {value:g}",
            same,
            round_ones,
            dict.fromkeys(NAMES, value),
        )


def _quaternions() -> Iterator[Row]:
    tiny = (
        "The least float32 can hold beside 1. Its slope is 2e7, as it must be: clipping the "
        "gradient's norm shortens that iteration's step."
    )
    none = "It turns nothing, and has no slope: no direction is better than another."
    for name, w, x, note in (
        ("that cancels to 0", -1.0, 0.0, none),
        ("that cancels to 1e-3", -1.0, 1e-3, "Its slope is 1e3."),
        ("that cancels to 6e-8", -1.0 + 2.0**-24, 2.0**-25, tiny),
        ("of a thousand", 1e3, -7e2, ""),
    ):
        quats = torch.tensor([w, x, 0.0, 0.0], dtype=torch.float64)
        yield f"quaternion {name}", note, {}, {"quats": quats}


def _close_camera() -> Row:
    mean = composed(ordinary_residuals())["means"][:, 0].detach()
    note = "The direction it is seen from turns by step / 1 mm; float32 places it to 1e-4 of 1 mm."
    eye = mean + torch.tensor([[6e-4, 0.0, 8e-4]], dtype=torch.float64)
    within = {"tolerance": Tolerance(1e-4, 1e-3)}
    return (
        "camera a millimetre from a Gaussian's middle",
        note,
        within,
        {"eye": eye},
    )


COS, SIN = math.cos(2.6), math.sin(2.6)
FRAMES = {
    "an elbow folded by 150 degrees": (
        (
            (1 + COS) / 2,
            -SIN / 2,
            0.0,
            SIN / 2,
            (1 + COS) / 2,
            0.0,
            0.0,
            0.0,
            1.0,
        ),
        "Half and half: a quarter as wide there.",
    ),
    "two bones half a turn apart": (
        (0.0,) * 8 + (1.0,),
        "Of rank 1: means move, and colours are seen, along one line only.",
    ),
    "four bones that cancel": (
        (0.0,) * 9,
        "Gaussians shrink to points that no residual moves; no direction to be seen from.",
    ),
}
"""Of a skinned body's points: means of rotations, which shear, flatten and vanish."""


def _step_zero(
    inputs: Inputs, backend: str, *, size: Size, settings: Accuracy
) -> dict[str, Tensor]:
    """Ψ itself, as it is built, on a pose."""
    p = inputs["p"]
    points = some_points(p.dtype, p.device)(p)
    camera = Camera(inputs["K"], inputs["R"], inputs["t"], size)
    gaussians = small_psi(p.dtype, p.device)(p, points, camera.centre)
    return rendered(gaussians, inputs, backend, size, settings)
