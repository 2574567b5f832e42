"""Residuals without a network: each Gaussian's are linear in nine harmonics of its own normal."""

import math
from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from gsgan.model.avatar import Avatar
from gsgan.model.body_points import BodyPoints
from gsgan.model.residual_gaussians import (
    PlacedPoints,
    ResidualGaussians,
    Residuals,
)
from gsgan.scene import BodyPose
from gsgan.skeleton import Points
from gsgan.splat.sh import sh_basis
from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError
from gsgan.utils.tensors import derive

HARMONICS = 9  # of degrees 0, 1 and 2
RIDGE = 0.02
SLOPE_RATE = 0.1  # times the constant's: else slopes overfit the training poses
FOLLOW = ("means", "sh", "features")
# Multipliers of the learning rate: bare parameters need higher rates than an MLP's weights.
RATES = {
    "means": 1.0,
    "quats": 1.0,
    "scales": 5.0,
    "opacities": 25.0,
    "sh": 10.0,
    "features": 10.0,
}
# makes the first harmonic 1, and the mean square of each
UNIT_HARMONIC = math.sqrt(4 * math.pi)
# joints, visibility, body: `gsgan.run.drive`
Pose = tuple[Tensor, Tensor, BodyPose | None]


def harmonics(normals: Tensor) -> Tensor:
    """``[..., 9]``: the real spherical harmonics of degrees 0 to 2, the first one 1.

    They are `gsgan.splat.sh.sh_basis` times √(4π). A normal of length r has r and r² times the
    harmonics of degree 1 and 2: where skinning flattens the surface, and normals fade to zero, the
    first one alone is left. A normal that is not finite counts as zero.

    Args:
        normals: ``[..., 3]`` in world axes, of length 1 or less.

    Source: the irradiance of a convex diffuse surface under distant light is within 1 % of such a
    function (Ramamoorthi and Hanrahan, 2001).
    """
    return UNIT_HARMONIC * sh_basis(normals.nan_to_num(0.0, 0.0, 0.0), 2)


class Harmonic(ResidualGaussians):
    """Linear functions of the `harmonics` of each point's posed normal, in Ψ's place.

    Args:
        rest_points: ``[N, 3]``; only their number is used.
        stature: metres, the subject's constant length scale.
        joints: not used.
        follow: names of `Residuals` that follow the normals; the others are constant.
        settings: of `ResidualGaussians`.

    Source: ours.
    """

    def __init__(
        self,
        rest_points: Tensor,
        stature: float,
        joints: int = 33,
        *,
        follow: Sequence[str] = FOLLOW,
        **settings: Any,
    ) -> None:
        super().__init__(stature, **settings)
        for name in follow:
            one_of("model.deformation.follow", name, tuple(RATES))
        count = len(rest_points)

        # Every Gaussian has a constant for each residual, and slopes for those that follow its
        # normal.
        sizes = dict(zip(RATES, self.parts, strict=True))
        # lists of pairs, since dictionaries would be sorted
        self.constants = nn.ParameterDict(
            [(x, torch.zeros(count, n)) for x, n in sizes.items()]
        )
        self.slopes = nn.ParameterDict(
            [
                (x, torch.zeros(count, HARMONICS - 1, n))
                for x, n in sizes.items()
                if x in follow
            ]
        )

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """(parameters, multiplier of the learning rate)."""
        constants = [([x], RATES[name]) for name, x in self.constants.items()]
        return constants + [
            ([x], SLOPE_RATE * RATES[name]) for name, x in self.slopes.items()
        ]

    @property
    def coefficients(self) -> Tensor:
        """``[N, 9, C]``: C is mean 3, quaternion 4, scale 3, opacity 1, colour 3 (d+1)² and
        features; `_geometry` and `colour_from` make Gaussians of the sums. Means count in
        `mean_step`."""
        columns = []

        # A residual that does not follow the normals has slopes of zero.
        for name, constant in self.constants.items():
            none = constant.new_zeros(
                len(constant), HARMONICS - 1, constant.shape[-1]
            )
            slopes = self.slopes.get(name, none)
            columns.append(torch.cat([constant.unsqueeze(1), slopes], dim=1))
        return torch.cat(columns, dim=-1)

    def residuals(
        self,
        points: Points,
        pose: Tensor,
        root: Tensor,
        chosen: Tensor | None = None,
    ) -> Residuals:
        """ΔG of posed points; pose and root are not used."""
        # The part that follows the normals; the first harmonic is 1, and its factor is the
        # constant.
        given = list(self.slopes.values())
        parts = {}
        if given:
            slopes = derive(
                self, "slopes", lambda: torch.cat(given, dim=-1), *given
            )
            # a product with N small matrices takes longer
            moved = (harmonics(points.normals)[..., 1:, None] * slopes).sum(-2)
            sizes = [x.shape[-1] for x in given]
            parts = dict(
                zip(self.slopes, moved.split(sizes, dim=-1), strict=True)
            )

        # Constants and moving parts are added; harmonics of colour that are not active are left
        # out, and so are features that nothing reads.
        active = {
            "sh": 3 * (self.active_degree + 1) ** 2,
            "features": self.active_features,
        }
        terms = []
        for name, constant in self.constants.items():
            used = active.get(name, constant.shape[-1])
            values = constant.expand(len(points.means), -1, -1)[..., :used]
            terms.append(
                values + parts[name][..., :used] if name in parts else values
            )

        # All residuals in the order of `Residuals`, of the chosen points.
        raw = torch.cat(terms, dim=-1)
        if chosen is not None:
            raw = raw.gather(
                1, chosen.unsqueeze(-1).expand(-1, -1, raw.shape[-1])
            )
        return self._split(raw)


@torch.no_grad()
def distil(
    avatar: Avatar,
    poses: Iterable[Pose],
    *,
    follow: Sequence[str] = FOLLOW,
    ridge: float = RIDGE,
    keep_offsets: bool = True,
) -> Avatar:
    """A frozen copy of an avatar with `Harmonic` residuals in Ψ's place: the least-squares fit to
    Ψ's over poses. An avatar that has such residuals already is copied.

    Args:
        avatar: trained, with Ψ.
        poses: joints ``[1, J, 3]``, visibility ``[1, J]`` and body pose of each (None: solved), as
            `gsgan.run.drive.inputs_of` and `gsgan.scene.Frame.inputs` have them.
        follow: see `Harmonic`; the others get their mean over the poses.
        ridge: penalty of each squared coefficient but the first, beside the mean over poses of the
            squared error.
        keep_offsets: False makes the offsets of `gsgan.model.pose_offsets` part of the residuals.

    Raises:
        ConfigError: when the avatar has no Ψ.
    """
    # The copy keeps every part but Ψ.
    copied = deepcopy(avatar)
    psi = copied.deformation
    if psi is None:
        raise ConfigError(
            "only avatars with Ψ have residuals to distil (model=full, splat_only)"
        )
    on_body = None if keep_offsets else copied.body_points
    moves = on_body is not None and on_body.offsets is not None
    if isinstance(psi, Harmonic) and not moves:
        return copied

    # All features are fitted, also those that a frozen avatar leaves out.
    psi.active_features = psi.features

    # The settings that bounds and activations depend on stay as they are.
    same = (
        "features",
        "sh_degree",
        "opacity",
        "mean_bound",
        "mean_step",
        "logit_bound",
    )
    settings: dict[str, Any] = {name: getattr(psi, name) for name in same}
    settings["scale_min"], settings["scale_max"] = psi.scale_range
    fitted = Harmonic(
        avatar.rest_points, psi.stature, follow=follow, **settings
    ).to(avatar.rest_points.device)

    # The fit over all poses. `Harmonic` multiplies its means by mean_step, so they are divided.
    samples = _samples(copied, psi, on_body, poses)
    maps, mean = ridge_regression(samples, ridge)
    maps[..., :3] /= psi.mean_step
    mean[..., :3] /= psi.mean_step

    # Each residual gets its columns: a linear map, or the mean over the poses.
    parts = (x.split(psi.parts, dim=-1) for x in (maps, mean))
    for name, linear, constant in zip(RATES, *parts, strict=True):
        fitted.constants[name].copy_(
            linear[:, 0] if name in follow else constant
        )
        if name in follow:
            fitted.slopes[name].copy_(linear[:, 1:])
    copied.deformation = fitted
    if on_body is not None:
        on_body.offsets = None
    return copied.freeze()


@dataclass(frozen=True)
class HarmonicSettings:
    """Settings of `Harmonic`: conf/model/deformation/harmonic.yaml."""

    features: int
    follow: Sequence[str]
    opacity: float
    mean_bound: float | None
    scale_min: float
    scale_max: float
    logit_bound: float

    def build(self, placed: PlacedPoints) -> Harmonic:
        """The residuals of a scene's points."""
        scale_max = placed.scale_max or self.scale_max
        return Harmonic(
            placed.rest_points,
            placed.stature,
            placed.joints,
            sh_degree=placed.sh_degree,
            mean_step=placed.mean_step,
            **(vars(self) | {"scale_max": scale_max}),
        )


def _samples(
    avatar: Avatar,
    psi: ResidualGaussians,
    on_body: BodyPoints | None,
    poses: Iterable[Pose],
) -> Iterator[tuple[Tensor, Tensor]]:
    """Harmonics ``[N, 9]`` and residuals ``[N, C]`` of each pose.

    With ``on_body`` the residuals of means include its offsets.
    """
    device = avatar.rest_points.device
    for p, visibility, given in poses:
        # The body is solved on the host, like the inputs.
        body = avatar.body_pose(p, visibility) if given is None else given
        body = None if body is None else body.to(device)

        # Ψ's residuals in this pose, without noise.
        valid = (visibility > 0).to(device)
        points, residuals = avatar.residuals(p.to(device), valid, body)
        if on_body is not None and body is not None:
            offset = on_body.offset(body)
            if offset is not None:
                means = psi.with_offset(residuals.means, offset)
                residuals = replace(residuals, means=means)

        # The columns are in the order of `Harmonic.coefficients`.
        values = [
            getattr(residuals, name).reshape(points.scales.numel(), -1)
            for name in RATES
        ]
        yield harmonics(points.normals[0]), torch.cat(values, dim=-1)


def ridge_regression(
    samples: Iterable[tuple[Tensor, Tensor]], ridge: float
) -> tuple[Tensor, Tensor]:
    """N linear maps, each from its own K inputs to C outputs, and the outputs' means.

    Args:
        samples: pairs ``[N, K]``, ``[N, C]``; the first input is 1.
        ridge: see `distil`; the first input has no penalty.

    Returns:
        ``[N, K, C]`` and ``[N, C]``, float64.
    """
    # Sums over the poses; the shapes follow from the first sample.
    count = 0
    gram = torch.zeros(())
    moment = torch.zeros(())
    for inputs, outputs in samples:
        x = inputs.double().unsqueeze(-1)
        y = outputs.double().unsqueeze(-2)
        count = count + 1
        gram = gram + x @ x.mT
        moment = moment + x @ y

    # Averages make the penalty independent of the number of poses.
    penalty = torch.full_like(gram[0, 0], ridge)
    penalty[0] = 0
    gram = gram / count
    moment = moment / count
    return torch.linalg.solve(gram + torch.diag(penalty), moment), moment[:, 0]
