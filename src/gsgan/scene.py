"""The nouns of gsgan: Camera, Gaussians, Raster, Frame.

Convention: metres, world frame; OpenCV cameras (x right, y down, z forward) with
``x_cam = R @ x_world + t``; pixel centres at +0.5; the first dimension is the batch, one camera
and one pose per batch item; images are RGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from gsgan.lens import distort_within
from gsgan.utils.constants import constant

S = TypeVar("S", bound="_TensorRecord")


@dataclass(frozen=True)
class _TensorRecord:
    """A frozen dataclass whose tensors (nested ones too) move and stack together."""

    def to(self: S, *args: Any, **kwargs: Any) -> S:
        """A copy with every tensor sent through ``Tensor.to``; integer labels keep their dtype."""
        changes: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, _TensorRecord):
                changes[field.name] = value.to(*args, **kwargs)
            elif isinstance(value, Tensor):
                changes[field.name] = _to(value, *args, **kwargs)
        return replace(self, **changes)

    def __getitem__(self: S, index: slice) -> S:
        """The batch items of a slice; the batch dimension stays."""
        if not isinstance(index, slice):
            raise TypeError(f"{type(self).__name__} takes a slice of the batch, got {index!r}")
        changes: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, (_TensorRecord, Tensor)) or (
                isinstance(value, tuple) and field.metadata.get("batched")
            ):
                changes[field.name] = value[index]
        return replace(self, **changes)


def _to(value: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    if value.is_floating_point():
        return value.to(*args, **kwargs)
    kwargs = {k: v for k, v in kwargs.items() if k != "dtype"}
    args = tuple(a for a in args if not isinstance(a, torch.dtype))
    return value.to(*args, **kwargs) if args or kwargs else value


def cat(records: Sequence[S]) -> S:
    """Joins records of one type along the batch dimension.

    Raises:
        ValueError: when the list is empty, or a field is present in some records only.
    """
    if not records:
        raise ValueError("cat: expected at least one record, got none")
    first, changes = records[0], {}
    for field in fields(first):
        values = [getattr(record, field.name) for record in records]
        if len({value is None for value in values}) == 2:
            raise ValueError(
                f"cat: {type(first).__name__}.{field.name} is present in some records only"
            )
        if isinstance(values[0], _TensorRecord):
            changes[field.name] = cat(values)
        elif isinstance(values[0], Tensor):
            changes[field.name] = torch.cat(values)
        elif any(value != values[0] for value in values):
            raise ValueError(
                f"cat: {type(first).__name__}.{field.name} differs between records: {values}"
            )
    return replace(first, **changes)


def _check(owner: str, name: str, value: Tensor, *shape: int | None) -> None:
    if not isinstance(value, Tensor):
        raise ValueError(f"{owner}: {name} must be a tensor, got {type(value).__name__}")
    wanted = [("B", "N", "C")[i] if size is None else str(size) for i, size in enumerate(shape)]
    if value.ndim != len(shape) or any(
        want is not None and want != have for want, have in zip(shape, value.shape, strict=True)
    ):
        raise ValueError(
            f"{owner}: {name} must have shape [{', '.join(wanted)}], got {list(value.shape)}"
        )


@dataclass(frozen=True)
class Camera(_TensorRecord):
    """A batch of cameras of one picture size, pinholes or with a lens.

    Args:
        K: ``[B, 3, 3]`` intrinsics in pixels of the picture, skew allowed.
        R: ``[B, 3, 3]`` world to camera rotation, det +1.
        t: ``[B, 3]`` metres, ``x_cam = R @ x_world + t``.
        size: ``(H, W)`` pixels, both at least 1.
        dist: ``[B, 5]`` OpenCV lens distortion (k1 k2 p1 p2 k3), or None for a pinhole.

    Raises:
        ValueError: on a wrong shape, size, or batch size, naming the argument.
    """

    K: Tensor
    R: Tensor
    t: Tensor
    size: tuple[int, int]
    dist: Tensor | None = None

    def __post_init__(self) -> None:
        _check("Camera", "K", self.K, None, 3, 3)
        _check("Camera", "R", self.R, None, 3, 3)
        _check("Camera", "t", self.t, None, 3)
        if self.dist is not None:
            _check("Camera", "dist", self.dist, None, 5)
        batches = {v.shape[0] for v in (self.K, self.R, self.t, self.dist) if v is not None}
        if len(batches) != 1:
            raise ValueError(
                f"Camera: K, R, t and dist must share one batch size, got {len(self.K)}, "
                f"{len(self.R)}, {len(self.t)}"
                + ("" if self.dist is None else f", {len(self.dist)}")
            )
        if len(self.size) != 2 or any(int(n) != n or n < 1 for n in self.size):
            raise ValueError(
                f"Camera: size must be (H, W) with both at least 1, got {tuple(self.size)}"
            )
        object.__setattr__(self, "size", (int(self.size[0]), int(self.size[1])))

    def __len__(self) -> int:
        return self.K.shape[0]

    @property
    def centre(self) -> Tensor:
        """``[B, 3]`` metres: where the camera stands in the world."""
        return -(self.R.mT @ self.t.unsqueeze(-1)).squeeze(-1)

    def to_camera(self, points: Tensor) -> Tensor:
        """``[B, M, 3]`` world points in camera axes, metres."""
        return points @ self.R.mT + self.t.unsqueeze(1)

    def project(self, points: Tensor, near: float = 1e-2) -> tuple[Tensor, Tensor]:
        """Pixel positions ``[B, M, 2]`` and depths ``[B, M]`` of world points ``[B, M, 3]``.

        Points nearer than ``near`` metres are divided by ``near`` instead of their depth: their
        pixels are finite but meaningless, so mask them by the returned depth. A lens (``dist``) is
        followed; what lies beyond its fold is shown at the fold's rim.
        """
        x_cam = self.to_camera(points)
        depth = x_cam[..., 2]
        xy1 = x_cam / depth.clamp_min(near).unsqueeze(-1)
        xy = xy1[..., :2] if self.dist is None else distort_within(xy1[..., :2], self.dist)
        xy1 = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)
        return (xy1 @ self.K.mT)[..., :2], depth

    def crop(self, top: int, left: int, size: tuple[int, int]) -> Camera:
        """The camera of a window ``size = (H, W)`` whose corner is pixel (top, left)."""
        shift = torch.zeros_like(self.K)
        shift[:, 0, 2], shift[:, 1, 2] = left, top
        return replace(self, K=self.K - shift, size=size)

    def resize(self, size: tuple[int, int]) -> Camera:
        """The camera of the whole picture resampled to ``size = (H, W)``."""
        scale = constant((size[1] / self.size[1], size[0] / self.size[0], 1.0), self.K)
        return replace(self, K=self.K * scale[:, None], size=size)


@dataclass(frozen=True)
class Gaussians(_TensorRecord):
    """A batch of 3D Gaussians, activated (no logs or logits).

    Shape comes from ``quats`` and ``scales``, or from ``covariances`` (LBS blends give shapes that
    no rotation and scale describe).

    Args:
        means: ``[B, N, 3]`` metres.
        quats: ``[B, N, 4]`` w x y z, normalised on use.
        scales: ``[B, N, 3]`` metres, > 0.
        opacities: ``[B, N]`` in [0, 1].
        features: ``[B, N, C]``, whatever is to be blended: colours, features, class votes.
        covariances: ``[B, N, 3, 3]`` square metres, in place of quats and scales.

    Raises:
        ValueError: on a wrong shape or a missing part, naming the argument.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    features: Tensor
    covariances: Tensor | None = None

    def __post_init__(self) -> None:
        _check("Gaussians", "means", self.means, None, None, 3)
        B, N = self.means.shape[:2]
        if self.covariances is not None:
            _check("Gaussians", "covariances", self.covariances, B, N, 3, 3)
        elif self.quats is None or self.scales is None:
            raise ValueError("Gaussians: give quats and scales, or covariances; got neither whole")
        if self.quats is not None:
            _check("Gaussians", "quats", self.quats, B, N, 4)
        if self.scales is not None:
            _check("Gaussians", "scales", self.scales, B, N, 3)
        _check("Gaussians", "opacities", self.opacities, B, N)
        _check("Gaussians", "features", self.features, B, N, None)
        if self.features.shape[-1] < 1:
            raise ValueError("Gaussians: features must have at least one channel, got 0")

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True)
class Raster(_TensorRecord):
    """What the rasteriser returns.

    Args:
        features: ``[B, C, H, W]`` premultiplied by alpha; the background is the caller's to add.
        alpha: ``[B, 1, H, W]`` in [0, 1].
        depth: ``[B, 1, H, W]`` metres times alpha, or None when it was not asked for.
        fine: ``[B, C, kH, kW]`` features before k² of them were averaged to a pixel, or None where
            the settings supersample nothing.
    """

    features: Tensor
    alpha: Tensor
    depth: Tensor | None = None
    fine: Tensor | None = None


@dataclass(frozen=True)
class BodyPose(_TensorRecord):
    """The pose of a skinned body.

    Args:
        theta: ``[B, bones, 3]`` axis-angle of each bone relative to its parent, radians.
        transl: ``[B, 3]`` metres, added to the root.
    """

    theta: Tensor
    transl: Tensor


@dataclass(frozen=True)
class Frame(_TensorRecord):
    """One moment seen by one camera, batched.

    Args:
        image: ``[B, 3, H, W]`` RGB in [0, 1], black where the mask is 0.
        mask: ``[B, 1, H, W]`` in [0, 1].
        camera: of this very picture (crops already in K).
        skeleton: ``[B, J, 3]`` metres, finite; joints never seen hold a stand-in and visibility 0.
        visibility: ``[B, J]`` in [0, 1].
        frame_id: ``[B]`` int64, the number in the file name.
        camera_index: ``[B]`` int64 into the dataset's camera names.
        body: pose of the skinned body, or None when the data has none.
        labels: ``[B, H, W]`` int64 part labels, 0 = background, or None.
        unsure: ``[B, 1, H, W]`` 1 where the colours are not to be learned from, or None.
    """

    image: Tensor
    mask: Tensor
    camera: Camera
    skeleton: Tensor
    visibility: Tensor
    frame_id: Tensor
    camera_index: Tensor
    body: BodyPose | None = None
    labels: Tensor | None = None
    unsure: Tensor | None = None

    def __len__(self) -> int:
        return self.image.shape[0]
