"""The nouns of gsgan: Camera, Gaussians, Raster, BodyPose, Frame, Window; and the lens model.

Lengths are in metres, in the world frame; cameras are OpenCV's (x right, y down, z forward) with
``x_cam = R @ x_world + t``; pixel centres at +0.5; the first dimension is the batch, one camera
and one pose per batch item; images are RGB in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.weak import WeakTensorKeyDictionary

from gsgan.utils.records import TensorRecord, cat
from gsgan.utils.tensors import constant, matvec

__all__ = [
    "BodyPose",
    "Camera",
    "Frame",
    "Gaussians",
    "Raster",
    "Window",
    "body_window",
    "cat",
    "distort",
    "distort_within",
    "fold_radius",
]

NEAR = 0.01  # metres: nearer points are not projected
RIM = 0.999  # share of a lens's fold radius: points beyond it are shown there
FAR = 1e4  # of x/z, y/z: the rim of a lens that does not fold


def _check(owner: str, name: str, value: Tensor, *shape: int | None) -> None:
    if not isinstance(value, Tensor):
        raise ValueError(
            f"{owner}: {name} must be a tensor, got {type(value).__name__}"
        )
    expected = [
        ("B", "N", "C")[i] if size is None else str(size)
        for i, size in enumerate(shape)
    ]
    if value.ndim != len(shape) or any(
        size is not None and size != got
        for size, got in zip(shape, value.shape, strict=True)
    ):
        raise ValueError(
            f"{owner}: {name} must have shape [{', '.join(expected)}], got {list(value.shape)}"
        )


@dataclass(frozen=True)
class Camera(TensorRecord):
    """A batch of cameras of one image size, pinholes or with a lens.

    Args:
        K: ``[B, 3, 3]`` intrinsics in pixels of the image, skew allowed.
        R: ``[B, 3, 3]`` world to camera rotation, det +1.
        t: ``[B, 3]`` metres, ``x_cam = R @ x_world + t``.
        size: ``(H, W)`` pixels, both at least 1.
        dist: ``[B, 5]`` OpenCV lens distortion (k1 k2 p1 p2 k3), or None for a pinhole.
        whole_height: pixels of the whole image, for the cameras of a `Window`; else None.

    Raises:
        ValueError: on a wrong shape, size, or batch size, naming the argument.
    """

    K: Tensor
    R: Tensor
    t: Tensor
    size: tuple[int, int]
    dist: Tensor | None = None
    whole_height: int | None = None

    def __post_init__(self) -> None:
        _check("Camera", "K", self.K, None, 3, 3)
        _check("Camera", "R", self.R, None, 3, 3)
        _check("Camera", "t", self.t, None, 3)
        if self.dist is not None:
            _check("Camera", "dist", self.dist, None, 5)

        # Broadcasting would accept one camera for many.
        batches = {
            v.shape[0]
            for v in (self.K, self.R, self.t, self.dist)
            if v is not None
        }
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
        """``[B, 3]`` metres: the camera's position in the world."""
        return -matvec(self.R.mT, self.t)

    @property
    def focal(self) -> Tensor:
        """``[B, 2]`` pixels: the focal lengths along x and y."""
        return self.K.diagonal(dim1=1, dim2=2)[:, :2]

    def to_camera(self, points: Tensor) -> Tensor:
        """``[B, M, 3]`` world points in camera axes, metres."""
        return points @ self.R.mT + self.t.unsqueeze(1)

    def project(
        self, points: Tensor, near: float = NEAR
    ) -> tuple[Tensor, Tensor]:
        """Pixel positions ``[B, M, 2]`` and depths ``[B, M]`` of world points ``[B, M, 3]``.

        Points nearer than ``near`` metres are divided by ``near`` instead of their depth: their
        pixels are finite but meaningless, so mask them by the returned depth. Lens distortion is
        applied; points beyond the lens's fold are shown at its rim.
        """
        x_cam = self.to_camera(points)
        depth = x_cam[..., 2]
        xy1 = x_cam / depth.clamp_min(near).unsqueeze(-1)
        xy = (
            xy1[..., :2]
            if self.dist is None
            else distort_within(xy1[..., :2], self.dist)
        )
        xy1 = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)
        return (xy1 @ self.K.mT)[..., :2], depth

    def crop(self, top: int, left: int, size: tuple[int, int]) -> Camera:
        """The camera of a window ``size = (H, W)`` whose corner is pixel (top, left)."""
        shift = torch.zeros_like(self.K)
        shift[:, 0, 2] = left
        shift[:, 1, 2] = top
        return replace(self, K=self.K - shift, size=size)

    def resize(self, size: tuple[int, int]) -> Camera:
        """The camera of the whole image resampled to ``size = (H, W)``."""
        scale = constant(
            (size[1] / self.size[1], size[0] / self.size[0], 1.0), self.K
        )
        return replace(self, K=self.K * scale[:, None], size=size)


@dataclass(frozen=True)
class Gaussians(TensorRecord):
    """A batch of 3D Gaussians, activated (no logs or logits).

    The shape is ``quats`` and ``scales``, or ``covariances`` (blended bone transforms shear, which
    no rotation and scale describes).

    Args:
        means: ``[B, N, 3]`` metres.
        quats: ``[B, N, 4]`` w x y z, normalised on use.
        scales: ``[B, N, 3]`` metres, > 0.
        opacities: ``[B, N]`` in [0, 1].
        features: ``[B, N, C]``, the values to blend: colours, features, class probabilities.
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
            raise ValueError(
                "Gaussians: give quats and scales, or covariances; got neither whole"
            )
        if self.quats is not None:
            _check("Gaussians", "quats", self.quats, B, N, 4)
        if self.scales is not None:
            _check("Gaussians", "scales", self.scales, B, N, 3)
        _check("Gaussians", "opacities", self.opacities, B, N)
        _check("Gaussians", "features", self.features, B, N, None)
        if self.features.shape[-1] < 1:
            raise ValueError(
                "Gaussians: features must have at least one channel, got 0"
            )

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True)
class Raster(TensorRecord):
    """The rasteriser's output.

    Args:
        features: ``[B, C, H, W]`` premultiplied by alpha; the caller adds the background.
        alpha: ``[B, 1, H, W]`` in [0, 1].
        fine: ``[B, C, kH, kW]`` features before supersampling averages k² of them to a pixel, or
            None without supersampling.
    """

    features: Tensor
    alpha: Tensor
    fine: Tensor | None = None


@dataclass(frozen=True)
class BodyPose(TensorRecord):
    """The pose of a skinned body.

    Args:
        theta: ``[B, bones, 3]`` axis-angle of each bone relative to its parent, radians.
        transl: ``[B, 3]`` metres, added to the root.
        bones: ``[B, bones, 4, 4]`` transforms of the bones since rest, where they are known.
        offsets: ``[B, C, 3]`` metres at rest: how the surface at the avatar's controls differs
            from what the pose tells, in registered training frames; else None.
    """

    theta: Tensor
    transl: Tensor
    bones: Tensor | None = None
    offsets: Tensor | None = None


@dataclass(frozen=True)
class Frame(TensorRecord):
    """One moment seen by one camera, batched.

    Args:
        image: ``[B, 3, H, W]`` RGB in [0, 1], black where the mask is 0.
        mask: ``[B, 1, H, W]`` in [0, 1].
        camera: of this image (crops already in K).
        skeleton: ``[B, J, 3]`` metres, finite; joints not seen hold a stand-in.
        visibility: ``[B, J]`` in [0, 1]; 0 for stand-ins.
        frame_id: ``[B]`` int64, the number in the file name.
        camera_index: ``[B]`` int64 into the dataset's camera names.
        body: pose of the skinned body, or None when the data has none.
        labels: ``[B, H, W]`` int64 part labels, 0 = background, or None.
        ignored: ``[B, 1, H, W]`` 1 where colours are excluded from the losses, or None.
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
    ignored: Tensor | None = None

    def __len__(self) -> int:
        return self.image.shape[0]

    @property
    def inputs(self) -> tuple[Tensor, Tensor, Camera, BodyPose | None, Tensor]:
        """The inputs of an avatar: skeleton, visibility, camera, body pose, camera index."""
        return (
            self.skeleton,
            self.visibility,
            self.camera,
            self.body,
            self.camera_index,
        )

    def unpack(self) -> Frame:
        """The frame with images in [0, 1] and labels as int64, of one whose pixels are bytes.

        A quarter to an eighth as much is then loaded and moved to a device.
        """
        return replace(
            self,
            image=unit(self.image),
            mask=unit(self.mask),
            labels=None if self.labels is None else self.labels.long(),
            ignored=None if self.ignored is None else unit(self.ignored),
        )


def unit(pixels: Tensor) -> Tensor:
    """Bytes as float32 in [0, 1]."""
    return pixels.to(torch.float32).div_(255)


@dataclass(frozen=True)
class Window:
    """One box per batch item, all of one size: the part of the image that holds the person.

    Args:
        corners: ``(top, left)`` of each item, pixels.
        size: ``(H, W)`` of every box.
        whole: ``(H, W)`` of the whole image.
    """

    corners: tuple[tuple[int, int], ...]
    size: tuple[int, int]
    whole: tuple[int, int]

    def part(self, side: int, at: Tensor) -> Window:
        """Smaller boxes inside these, of at most ``side`` pixels each way.

        Args:
            side: pixels.
            at: ``[B, 2]`` the centre of each in its box, row and column in [0, 1]; a part that
                would reach beyond its box is moved inside. On the CPU.
        """
        size = (min(side, self.size[0]), min(side, self.size[1]))
        corners = []
        for (top, left), (row, column) in zip(
            self.corners, at.tolist(), strict=True
        ):
            # Inside its box, however near to the border.
            y = round(row * self.size[0] - size[0] / 2)
            x = round(column * self.size[1] - size[1] / 2)
            y = min(max(0, y), self.size[0] - size[0])
            x = min(max(0, x), self.size[1] - size[1])
            corners.append((top + y, left + x))
        return Window(tuple(corners), size, self.whole)

    def within(self, window: Window) -> Window:
        """Boxes of images that are themselves boxes: where they are in the whole images."""
        corners = tuple(
            (top + outer_top, left + outer_left)
            for (top, left), (outer_top, outer_left) in zip(
                self.corners, window.corners, strict=True
            )
        )
        return Window(corners, self.size, window.whole)

    def camera(self, camera: Camera) -> Camera:
        """The cameras of the boxes."""
        shift = torch.zeros_like(camera.K)
        for i, (top, left) in enumerate(self.corners):
            shift[i, 0, 2] = left
            shift[i, 1, 2] = top
        return replace(
            camera,
            K=camera.K - shift,
            size=self.size,
            whole_height=camera.whole_height or self.whole[0],
        )

    def raster(self, raster: Raster) -> Raster:
        """The boxes of what was splatted."""
        fine = raster.fine
        if fine is not None:
            k = fine.shape[-1] // raster.alpha.shape[-1]
            corners = tuple((k * top, k * left) for top, left in self.corners)
            height, width = self.size
            fine = replace(
                self, corners=corners, size=(k * height, k * width)
            ).cut(fine)
        return Raster(self.cut(raster.features), self.cut(raster.alpha), fine)

    def cut(self, images: Tensor) -> Tensor:
        """``[B, ..., H, W]`` reduced to the boxes."""
        height, width = self.size
        boxes = [
            images[i : i + 1, ..., top : top + height, left : left + width]
            for i, (top, left) in enumerate(self.corners)
        ]
        return torch.cat(boxes)

    def frame(self, frame: Frame) -> Frame:
        """The frame seen through the boxes."""
        return replace(
            frame,
            image=self.cut(frame.image),
            mask=self.cut(frame.mask),
            labels=None if frame.labels is None else self.cut(frame.labels),
            ignored=None if frame.ignored is None else self.cut(frame.ignored),
            camera=self.camera(frame.camera),
        )

    def paste(self, boxes: Tensor) -> Tensor:
        """``[B, C, h, w]`` boxes back in whole images, zeros around them."""
        (height, width), (whole_height, whole_width) = self.size, self.whole
        pasted = [
            functional.pad(
                boxes[i : i + 1],
                (
                    left,
                    whole_width - left - width,
                    top,
                    whole_height - top - height,
                ),
            )
            for i, (top, left) in enumerate(self.corners)
        ]
        return torch.cat(pasted)


def body_window(
    p: Tensor,
    camera: Camera,
    *,
    margin: float,
    multiple: int,
    minimum: int,
    near: float = NEAR,
) -> Window:
    """The boxes round the projected joints; they depend on skeleton and camera only.

    Args:
        p: ``[B, J, 3]`` metres, finite.
        camera: B cameras.
        margin: metres kept round every joint (hair, fingertips, clothes).
        multiple: sides are rounded up to multiples of this many pixels, where the image has room.
        minimum: pixels, the shortest side, where the image has room.
        near: metres; with a joint nearer than this the box is the whole image.

    Returns:
        Boxes inside the image.
    """
    height, width = camera.size

    # The joints' pixels, and how many pixels the margin takes at each joint's depth.
    pixels, depth = camera.project(p)
    focal = camera.focal
    reach = margin * focal[:, None] / depth.clamp_min(near).unsqueeze(-1)
    low = (pixels - reach).amin(dim=1).floor()
    high = (pixels + reach).amax(dim=1).ceil()

    # The box is clipped to the image; a joint behind the camera makes it the whole image.
    everywhere = constant((width, height), low)
    behind = (depth < near).any(dim=1, keepdim=True)
    low = (
        torch.where(behind, torch.zeros_like(low), low)
        .clamp_min(0)
        .minimum(everywhere - 1)
    )
    high = (
        torch.where(behind, everywhere.expand_as(high), high)
        .clamp_min(1)
        .minimum(everywhere)
    )

    # All boxes of a batch have the size of the largest, each about its own centre.
    bounds = torch.cat([low, high], dim=-1).long().tolist()
    w = _side(
        max(minimum, *(x1 - x0 for x0, _, x1, _ in bounds)), multiple, width
    )
    h = _side(
        max(minimum, *(y1 - y0 for _, y0, _, y1 in bounds)), multiple, height
    )
    corners = tuple(
        (_start(y0, y1, h, height), _start(x0, x1, w, width))
        for x0, y0, x1, y1 in bounds
    )
    return Window(corners, (h, w), (height, width))


def _side(length: int, multiple: int, limit: int) -> int:
    return min(-(-max(1, length) // multiple) * multiple, limit)


def _start(low: int, high: int, side: int, limit: int) -> int:
    """Where a box of ``side`` begins that is centred on [low, high) and inside [0, limit)."""
    return min(max(0, (low + high - side) // 2), limit - side)


# -- lenses: OpenCV's model (k1 k2 p1 p2 k3) on x/z and y/z of the camera's axes


def distort(points: Tensor, dist: Tensor) -> tuple[Tensor, Tensor]:
    """Where lenses ``[B, 5]`` show points ``[B, M, 2]`` of the z = 1 plane.

    Returns:
        The points ``[B, M, 2]`` and their derivatives ``[B, M, 2, 2]``.
    """
    # Radial terms in r², then tangential ones.
    x, y = points.unbind(-1)
    k1, k2, p1, p2, k3 = (c.unsqueeze(-1) for c in dist.unbind(-1))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # of radial, by x it is slope * x
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    shown = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    ]

    # The derivatives; the mixed ones are equal.
    across = slope * x * y + 2 * p1 * x + 2 * p2 * y
    rows = [
        torch.stack(
            [radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, across], dim=-1
        ),
        torch.stack(
            [across, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x], dim=-1
        ),
    ]
    return torch.stack(shown, dim=-1), torch.stack(rows, dim=-2)


def distort_within(points: Tensor, dist: Tensor) -> Tensor:
    """The points of `distort`, those beyond the lens's fold clamped to its rim.

    The polynomial folds points beyond that radius back into the image, which no lens does.
    """
    radius = points.norm(dim=-1, keepdim=True)
    rim = RIM * fold_radius(dist).to(points.dtype)[:, None, None]

    # Quotients are finite, and so is their gradient, at the axis and for lenses that never fold.
    rim = rim.clamp_max(FAR)
    return distort(points * (rim / torch.maximum(radius, rim)), dist)[0]


def fold_radius(dist: Tensor) -> Tensor:
    """``[B]`` of x/z, y/z: where lenses ``[B, 5]`` first fold back, p1 and p2 aside; else inf.

    It is computed once for a tensor without gradient, which must not be changed in place.
    """
    if dist.requires_grad or torch.compiler.is_compiling():
        return _fold_radius(dist)
    if (radius := _folds.get(dist)) is None:
        # else of no use in training later
        with torch.inference_mode(False), torch.no_grad():
            radius = _folds[dist] = _fold_radius(dist)
    return radius


_folds: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def _fold_radius(dist: Tensor) -> Tensor:
    k1, k2, _, _, k3 = dist.double().unbind(-1)
    # the slope 1 + 3 k1 s + 5 k2 s² + 7 k3 s³ by s = r², as a cubic in 1/s, whose first term is 1
    companion = torch.zeros(*k1.shape, 3, 3, dtype=k1.dtype, device=k1.device)
    companion[..., 0, :] = torch.stack([-3 * k1, -5 * k2, -7 * k3], dim=-1)
    companion[..., 1, 0] = companion[..., 2, 1] = 1

    # The smallest positive radius is the largest root in 1/s.
    roots = torch.linalg.eigvals(companion)
    real = roots.imag.abs() < 1e-9 * roots.abs()
    return torch.where(real, roots.real, 0).clamp_min(0).amax(dim=-1).rsqrt()
