"""Random scenes for hypothesis: sizes, opacities, poses, cameras from one extreme to another."""

from __future__ import annotations

import torch
from hypothesis import strategies as st

from stability.cases.case import Inputs
from stability.cases.raster import pinhole

Size = tuple[int, int]


@st.composite
def scenes(
    draw: st.DrawFn,
    log_scale: tuple[float, float] = (-6.0, 3.0),
    log_ratio: tuple[float, float] = (0.05, 4.0),
) -> tuple[Inputs, Size]:
    """Gaussians in front of, beside and behind a camera anywhere, and the image's size.

    Args:
        draw: hypothesis'.
        log_scale: powers of ten of the largest standard deviation, metres.
        log_ratio: powers of ten of largest to least standard deviation; above 0, as the
            quaternion of a ball has a gradient of rounding only.
    """
    size = draw(st.tuples(st.integers(1, 20), st.integers(1, 20)))
    angle, metres = st.floats(-3, 3), st.floats(-100, 100)
    camera = pinhole(
        size,
        focal=10 ** draw(st.floats(0.5, 3.0)),
        skew=draw(st.floats(-3, 3)),
        centre=draw(st.tuples(st.floats(0, size[1]), st.floats(0, size[0]))),
        aspect=draw(st.floats(0.5, 2)),
        axis_angle=draw(st.tuples(angle, angle, angle)),
        t=draw(st.tuples(metres, metres, metres)),
    )
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**16)))
    scale, ratio = draw(st.floats(*log_scale)), draw(st.floats(*log_ratio))
    distance = 10 ** draw(st.floats(-1, 2))
    opacities = draw(st.sampled_from([(0.0, 1.0), (0.0, 0.01), (0.9, 1.0), (1.0, 1.0)]))
    n = draw(st.integers(1, 10))

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(1, n, *shape, generator=generator, dtype=torch.float64)

    # Pixels over the image and round it, depths from behind the camera to twice the distance.
    pixels = torch.tensor([size[1], size[0]]) * (2 * rand(2) - 0.5)
    depths = distance * (2.5 * rand(1) - 0.5)
    homogeneous = torch.cat([pixels, torch.ones_like(depths)], dim=-1)
    x_cam = depths * (homogeneous @ torch.linalg.inv(camera["K"]).mT)
    return {
        "means": (x_cam - camera["t"].unsqueeze(1)) @ camera["R"],
        "quats": torch.randn(1, n, 4, generator=generator, dtype=torch.float64),
        "scales": 10 ** (scale - ratio * rand(3)),
        "opacities": opacities[0] + (opacities[1] - opacities[0]) * rand(),
        "features": rand(3),
        **camera,
    }, size
