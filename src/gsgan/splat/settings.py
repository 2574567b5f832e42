"""Accuracy settings: the named cut-offs of the rasteriser."""

from dataclasses import dataclass

import torch

_EXTENTS = ("all", "opacity", "sigma")
_DTYPES = {"float32": torch.float32, "float64": torch.float64}


@dataclass(frozen=True)
class Accuracy:
    """The contributions that the rasteriser may skip.

    Two rules hold in every backend. A contribution with ``alpha < alpha_min`` is skipped. A
    contribution whose incoming transmittance (the product of ``1 - alpha`` over the contributions
    in front of it that were not skipped) is below ``transmittance_min`` is skipped, and so is
    everything behind it.

    ``extent`` is ``all`` (wherever a float64 ``exp`` is not 0), ``opacity`` (the box of the ellipse
    ``alpha >= alpha_min``: skips nothing that alpha_min does not) or ``sigma`` (a box of
    ``radius_sigmas`` standard deviations). Inputs of a higher precision raise that of ``dtype``.

    Raises:
        ValueError: on a value outside its range, naming it.

    Source: docs/rasteriser.md; the paper (Sec. 3.1) states no cut-off, 1/255 and 0.3 square pixels
    are the values of 3D Gaussian splatting.
    """

    name: str  # in configs and tables
    alpha_min: float  # in [0, 1); 0 keeps every contribution
    transmittance_min: float  # in [0, 1); 0 never stops a pixel
    extent: str  # all, opacity or sigma
    dtype: str  # float32 or float64, of the arithmetic
    radius_sigmas: float = 3.0  # for the extent ``sigma``
    near: float = 0.01  # metres; Gaussians whose mean is nearer are not drawn
    # Near 1 the gradient of hidden layers is lost in float32 rounding: 1 is for float64.
    alpha_max: float = 0.999
    # square pixels, added to the diagonal of every 2D covariance
    low_pass: float = 0.3
    # Half fields of view, to which x/z and y/z are clamped in the projection's Jacobian, >= 1.
    fov_clamp: float = 1.3
    # Whether opacities are multiplied by sqrt(det before / det after) of the low-pass.
    antialias: bool = False
    # draw this many times larger, low-pass included, then average
    supersample: int = 1

    def __post_init__(self) -> None:
        # The cut-offs of contributions.
        self._require("alpha_min", 0 <= self.alpha_min < 1, "in [0, 1)")
        self._require(
            "transmittance_min", 0 <= self.transmittance_min < 1, "in [0, 1)"
        )
        self._require(
            "extent",
            self.extent in _EXTENTS,
            f"one of {', '.join(_EXTENTS)}",
        )
        self._require(
            "dtype", self.dtype in _DTYPES, f"one of {', '.join(_DTYPES)}"
        )
        self._require("radius_sigmas", self.radius_sigmas > 0, "> 0")

        # The projection, and the limits of opacity.
        self._require("near", self.near > 0, "> 0 metres")
        self._require(
            "alpha_max",
            self.alpha_min < self.alpha_max <= 1,
            "in (alpha_min, 1]",
        )
        self._require("low_pass", self.low_pass > 0, "> 0 square pixels")
        self._require("fov_clamp", self.fov_clamp >= 1, ">= 1")

        # A bool is an int in Python, but no number of pixels.
        whole = isinstance(self.supersample, int) and not isinstance(
            self.supersample,
            bool,
        )
        self._require(
            "supersample",
            whole and self.supersample >= 1,
            "a whole number >= 1",
        )

    def _require(self, field: str, holds: bool, expected: str) -> None:
        if not holds:
            raise ValueError(
                f"Accuracy: {field} must be {expected}, got {getattr(self, field)!r}"
            )

    @property
    def torch_dtype(self) -> torch.dtype:
        """The lowest floating-point precision of the arithmetic."""
        return _DTYPES[self.dtype]

    @property
    def is_dense(self) -> bool:
        """Whether every Gaussian contributes to every pixel."""
        return (
            self.extent == "all"
            and self.alpha_min == self.transmittance_min == 0
        )


ACCURACY = {
    "exact": Accuracy(
        name="exact",
        alpha_min=0.0,
        transmittance_min=0.0,
        extent="all",
        dtype="float64",
        alpha_max=1.0,
    ),
    "high": Accuracy(
        name="high",
        alpha_min=1e-5,
        transmittance_min=1e-5,
        extent="opacity",
        dtype="float32",
    ),
    "standard": Accuracy(
        name="standard",
        alpha_min=1 / 255,
        transmittance_min=1e-4,
        extent="opacity",
        dtype="float32",
    ),
    "draft": Accuracy(
        name="draft",
        alpha_min=1 / 64,
        transmittance_min=1e-2,
        extent="sigma",
        dtype="float32",
    ),
}
"""The presets, as in conf/accuracy."""


def accuracy(name: str) -> Accuracy:
    """The preset with a name.

    Raises:
        ValueError: on an unknown name.
    """
    if name not in ACCURACY:
        raise ValueError(
            f"accuracy: expected one of {', '.join(ACCURACY)}, got {name!r}"
        )
    return ACCURACY[name]
