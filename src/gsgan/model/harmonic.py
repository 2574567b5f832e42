"""Residuals without a network: each Gaussian's are linear in nine harmonics of its own normal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from copy import deepcopy

import torch
from torch import Tensor, nn

from gsgan.model.avatar import Avatar
from gsgan.model.deformation import ResidualGaussians, Residuals
from gsgan.scene import BodyPose
from gsgan.skeleton import Points
from gsgan.splat.sh import sh_basis
from gsgan.utils.errors import ConfigError

HARMONICS = 9  # of degrees 0, 1 and 2
RIDGE = 0.1
UNIT = math.sqrt(4 * math.pi)  # makes the first harmonic 1, and the mean square of each
Pose = tuple[Tensor, Tensor, BodyPose | None]  # joints, visibility, body: `gsgan.model.drive`


def harmonics(normals: Tensor) -> Tensor:
    """``[..., 9]``: the real spherical harmonics of degrees 0 to 2, the first one 1.

    Convention: `gsgan.splat.sh.sh_basis` times √(4π). A normal of length r has r and r² times the
    harmonics of degree 1 and 2: where skinning flattens the surface, and normals fade to zero, the
    first one alone is left. A normal that is not finite counts as zero.

    Args:
        normals: ``[..., 3]`` in world axes, of length 1 or less.

    Source: the irradiance of a convex diffuse surface under distant light is within 1 % of such a
    function (Ramamoorthi and Hanrahan, 2001).
    """
    return UNIT * sh_basis(normals.nan_to_num(0.0, 0.0, 0.0), 2)


class Harmonic(ResidualGaussians):
    """Linear functions of the `harmonics` of each point's posed normal, in Ψ's place.

    Args:
        rest_points: ``[N, 3]``; only their number is used.
        body_height: metres, the subject's constant length scale.
        joints: not used.
        settings: of `ResidualGaussians`.

    Source: ours.
    """

    def __init__(
        self, rest_points: Tensor, body_height: float, joints: int = 33, **settings: object
    ) -> None:
        super().__init__(body_height, **settings)  # type: ignore[arg-type]
        count = len(rest_points)
        self.coefficients = nn.Parameter(torch.zeros(count, HARMONICS, sum(self.parts)))

    def residuals(self, points: Points, pose: Tensor, root: Tensor, pelvis: Tensor) -> Residuals:
        """ΔG of posed points; pose, root and pelvis are not used."""
        basis = harmonics(points.normals)  # [B, N, 9]
        return self._parted(torch.einsum("bnk,nkc->bnc", basis, self._active(self.coefficients)))


@torch.no_grad()
def distilled(avatar: Avatar, poses: Iterable[Pose], ridge: float = RIDGE) -> Avatar:
    """A frozen copy of an avatar with `Harmonic` residuals in Ψ's place: the least-squares fit to
    Ψ's over poses. An avatar that has such residuals already is copied.

    Args:
        avatar: trained, with Ψ.
        poses: joints ``[1, J, 3]``, visibility ``[1, J]`` and body pose of each, as
            `gsgan.model.drive.inputs_of` and `gsgan.scene.Frame.inputs` have them.
        ridge: penalty of each squared coefficient but the first, beside the mean over poses of the
            squared error.

    Raises:
        ConfigError: when the avatar has no Ψ.
    """
    found, psi = deepcopy(avatar), avatar.deformation
    if psi is None:
        raise ConfigError("only avatars with Ψ have residuals to distil (model=full, splat_only)")
    if isinstance(psi, Harmonic):
        return found
    solved = ridge_regression(_samples(avatar, poses), ridge)
    solved[..., :3] /= psi.mean_step
    settings = ("features", "sh_degree", "opacity", "mean_bound", "mean_step", "logit_bound")
    low, high = psi.scale_range
    found.deformation = Harmonic(
        solved,
        psi.body_height,
        scale_min=low,
        scale_max=high,
        **{name: getattr(psi, name) for name in settings},
    )
    found.deformation.coefficients.copy_(solved)
    return found.freeze()


def _samples(avatar: Avatar, poses: Iterable[Pose]) -> Iterator[tuple[Tensor, Tensor]]:
    """Harmonics ``[N, 9]`` and residuals ``[N, C]`` of each pose."""
    for p, visibility, body in poses:
        points, residuals = avatar.residuals(p, visibility > 0, body)
        yield harmonics(points.normals[0]), _joined(residuals)[0]


def ridge_regression(samples: Iterable[tuple[Tensor, Tensor]], ridge: float) -> Tensor:
    """``[N, K, C]`` float64: N linear maps, each from its own K inputs to C outputs.

    Args:
        samples: pairs ``[N, K]``, ``[N, C]``.
        ridge: see `distilled`; the first input has no penalty.
    """
    count, gram, moment = 0, torch.zeros(()), torch.zeros(())
    for inputs, outputs in samples:
        x, y = inputs.double().unsqueeze(-1), outputs.double().unsqueeze(-2)
        count, gram, moment = count + 1, gram + x @ x.mT, moment + x @ y
    penalty = torch.full_like(gram[0, 0], ridge)
    penalty[0] = 0
    return torch.linalg.solve(gram / count + torch.diag(penalty), moment / count)


def _joined(residuals: Residuals) -> Tensor:
    """``[B, N, C]``: mean 3, quaternion 4, scale 3, opacity 1, colour 3 (d+1)², features."""
    r = residuals
    parts = (r.means, r.quats, r.scales, r.opacities.unsqueeze(-1), r.sh.flatten(-2), r.features)
    return torch.cat(parts, dim=-1)
