"""The avatar: skeleton and camera in, image out. `forward` follows the paper's figure."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Literal, Self

import torch
from torch import Tensor, nn

from gsgan.body.solve import Solver
from gsgan.effects import Effects
from gsgan.model.body_points import BodyPoints
from gsgan.model.deformation import Deformation, bounded
from gsgan.model.generator import Generator
from gsgan.model.painting import ColourCorrection, Painting
from gsgan.model.segmentation import Segmentation
from gsgan.model.surface import SurfaceGaussians
from gsgan.scene import BodyPose, Camera, Frame, Gaussians, Window, body_window, cat
from gsgan.skeleton import (
    MEDIAPIPE33,
    BoneFrames,
    Densify,
    Points,
    SkeletonTemplate,
    bone_frames,
    complete_skeleton,
    draw_skeleton,
    face_code,
    omega,
    root_of,
)
from gsgan.splat import Accuracy, rasterise
from gsgan.splat.checks import checks_for
from gsgan.utils.tensors import full_precision

LINE_WIDTH = 2.5  # sigma of p₂D's lines, pixels in an image 512 high
UNWATCHED: AbstractContextManager[None] = nullcontext()  # entering it costs next to nothing


def unwatched(stage: str) -> AbstractContextManager[None]:
    """The context of a stage while no bench times it."""
    return UNWATCHED


class Avatar(nn.Module):
    """One person: Gaussians, segmentation, pose code and generator.

    `gsgan.model.assemble` builds the parts; `gsgan.load` loads a trained avatar.

    Args:
        effects: decided when training began.
        accuracy: the rasteriser's settings for F.
        template: of the skeletons that drive it.
        limb_length_sum: metres, the subject's summed limb lengths.
        body_height: metres, the subject's stature: the length scale of the networks' inputs.
        deformation: Ψ; with it either densify (Alg. 1) or body_points places G.
        surface: Gaussians on the body's surface, in place of Ψ (``lbs_splat``).
        segmentation: S, or None (``wo_seg``); segmentation_why says where its labels come from, or
            why there is none.
        pose_encoder, generator: None in ``splat_only``, where Step I's colour is the image.
        colour: per-camera colour correction, where that effect is on.
        solver: of body poses that are not given, for avatars on a skinned body.
        backend: that rasterises F, see `gsgan.splat.rasterise`.
        twist: of bone frames, see `gsgan.skeleton.bone_frames`.
        window_margin, window_multiple, window_least: of the painted window, pixels and metres; see
            `gsgan.scene.body_window`. No margin paints whole images.

    Source: paper Fig. 3 and Sec. 3.
    """

    # Replaced by benches: the context in which each stage runs, by its name.
    stage: Callable[[str], AbstractContextManager[None]] = staticmethod(unwatched)

    def __init__(
        self,
        *,
        effects: Effects,
        accuracy: Accuracy,
        limb_length_sum: float,
        body_height: float,
        template: SkeletonTemplate = MEDIAPIPE33,
        deformation: Deformation | None = None,
        densify: Densify | None = None,
        body_points: BodyPoints | None = None,
        surface: SurfaceGaussians | None = None,
        segmentation: Segmentation | None = None,
        segmentation_why: str = "",
        pose_encoder: nn.Module | None = None,
        generator: Generator | None = None,
        colour: ColourCorrection | None = None,
        solver: Solver | None = None,
        backend: str = "auto",
        twist: Literal["none", "hinge"] = "none",
        window_margin: float | None = 0.25,
        window_multiple: int = 16,
        window_least: int = 32,
    ) -> None:
        super().__init__()
        self.effects, self.accuracy, self.backend = effects, accuracy, backend
        self.limb_length_sum, self.body_height = limb_length_sum, body_height
        self.template, self.twist = template, twist
        self.window_margin = window_margin
        self.window_multiple, self.window_least = window_multiple, window_least
        self.deformation, self.densify, self.body_points = deformation, densify, body_points
        self.surface = surface
        self.segmentation, self.segmentation_why = segmentation, segmentation_why
        self.pose_encoder, self.generator, self.colour = pose_encoder, generator, colour
        self.solver = solver

    @property
    def splats(self) -> Deformation | SurfaceGaussians | None:
        """The part that makes Gaussians and learns in Step I."""
        return self.deformation or self.surface

    @property
    def splat_channels(self) -> int:
        """Channels of F, colour included; 0 where nothing is splatted."""
        return 0 if self.splats is None else 3 + self.splats.features

    @property
    def needs_body(self) -> bool:
        """Whether parts move with a skinned body, whose pose is given or solved."""
        return any(part for part in (self.body_points, self.surface, self.segmentation))

    def freeze(self) -> Self:
        """Ends training, and paints faster: what depends on weights alone is computed once.

        Convention: images are the same up to rounding, and follow weights that are loaded later.
        Weights get no gradient any more; skeleton and camera do.
        """
        self.eval().requires_grad_(False)
        for part in self.modules():
            part.derived = {}  # type: ignore[assignment]
        return self.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]

    @torch.no_grad()
    def render(
        self,
        skeleton: Tensor,
        camera: Camera,
        *,
        visibility: Tensor | None = None,
        body: BodyPose | None = None,
        background: float | tuple[float, float, float] = 0.0,
    ) -> Tensor:
        """The image ``[B, 3, H, W]`` of a new pose, RGB in [0, 1], corrected for no camera.

        Args:
            skeleton, camera, visibility, body: see `picture`.
            background: RGB in [0, 1], or one number for all three.
        """
        painting = self.picture(skeleton, camera, visibility=visibility, body=body)
        assert painting.image is not None and painting.alpha is not None  # noqa: PT018
        colour = painting.image.new_tensor(background).expand(3).view(1, 3, 1, 1)
        image = painting.image.clamp(0, 1)
        return (image + (1 - painting.alpha.clamp(0, 1)) * colour).clamp(0, 1)

    @torch.no_grad()
    def picture(
        self,
        skeleton: Tensor,
        camera: Camera,
        *,
        visibility: Tensor | None = None,
        body: BodyPose | None = None,
        camera_index: Tensor | None = None,
        maps: bool = False,
    ) -> Painting:
        """Image and alpha of a new pose.

        Convention: inputs are moved to the avatar's device, where the image stays.

        Args:
            skeleton: ``[J, 3]`` or ``[B, J, 3]`` metres, world frame; NaN for joints not seen. An
                avatar with hands and face takes skeletons without: they are not seen. One without
                leaves them out.
            camera: B cameras, or one for all.
            visibility: ``[J]`` or ``[B, J]`` in [0, 1]; 0 marks a stand-in; None: all seen.
            body: B poses of the skinned body; None: solved from the skeleton where it is needed.
            camera_index: ``[B]`` cameras whose colours to correct for; None corrects nothing.
            maps: keep the maps that led to the image, and the Gaussians.

        Returns:
            A painting of image and alpha alone, unless maps are kept; not clamped.

        Raises:
            ValueError: on wrong shapes, when too few shoulders and hips are finite, or when a body
                pose must be solved and left and right are swapped.
        """
        device = next(self.parameters()).device
        height = self.limb_length_sum
        p, seen = complete_skeleton(skeleton.to(device), visibility, self.template, height)
        if len(camera) not in (1, len(p)):
            raise ValueError(f"render: expected 1 or {len(p)} cameras, got {len(camera)}")
        cameras = camera if len(camera) == len(p) else cat([camera] * len(p))
        body = None if body is None else body.to(device)
        index = None if camera_index is None else camera_index.to(device)
        return self._paint(p, seen, cameras.to(device), body, index, maps=maps)

    def forward(
        self,
        skeleton: Tensor,
        visibility: Tensor,
        camera: Camera,
        body: BodyPose | None = None,
        *,
        pose_noise: Tensor | None = None,
        paint: bool = True,
        supersample: bool = True,
        detach_features: bool = False,
        picture_height: int | None = None,
        camera_index: Tensor | None = None,
    ) -> Painting:
        """Paints a pose: I_pred and every map that led to it.

        Args:
            skeleton: ``[B, J, 3]`` metres, world, finite: `gsgan.skeleton.sanitise` replaces joints
                that were not seen.
            visibility: ``[B, J]`` in [0, 1]; 0 marks a stand-in.
            camera: B cameras.
            body: pose of the skinned body; see `needs_body` and `body_pose`.
            pose_noise: ``[B, J, 3]`` added to Ψ's pose code, in its units (training only).
            paint: False stops after F (Step I needs no more).
            supersample: False draws F once per pixel, whatever ``accuracy`` says.
            detach_features: keep Step II's gradient out of Ψ.
            picture_height: pixels of the whole image, when ``camera`` sees a window of it: the
                drawn skeleton's lines are as wide as they would be there.
            camera_index: ``[B]`` cameras whose colours to correct for; None corrects nothing.
        """
        paints = paint and self.generator is not None
        with full_precision(skeleton):
            with self.stage("skeleton"):
                p, valid = skeleton, visibility > 0
                frames = bone_frames(p, valid, self.template, twist=self.twist)

            gaussians = self.splat(p, valid, frames, camera, body, pose_noise)
            raster = None
            accuracy = self.accuracy if supersample else replace(self.accuracy, supersample=1)
            if gaussians is not None:
                gaussians = self.bounded(gaussians)
                with self.stage("F"):
                    raster = rasterise(
                        gaussians,
                        camera,
                        settings=accuracy,
                        backend=self.backend,
                        on_invalid=checks_for(skeleton.device),
                    )
            S = self.segment(body, camera) if paints else None  # Sec. 3.4
            p2d = self.draw(p, valid, camera, picture_height) if paints else None
            pose = self.pose_inputs(p, valid, frames, camera) if paints else None

        image = alpha = None
        if self.generator is None and raster is not None:
            image, alpha = raster.features[:, :3], raster.alpha
        if paints:  # Sec. 3.5
            with self.stage("pose encoder"):
                g = self.pose_encoder(*pose)  # type: ignore[misc]
            with self.stage("UNet"):
                inputs = (p2d, S, None, g)  # image_to_image: the drawing stands in F's place
                if raster is not None:
                    seen = (raster.features, raster.fine, raster.alpha)
                    if detach_features:
                        seen = tuple(None if x is None else x.detach() for x in seen)  # type: ignore[assignment]
                    inputs = (seen[0], S, p2d, g, *seen[1:])  # type: ignore[assignment]
                painted = self.generator(*inputs).to(skeleton.dtype)  # type: ignore[misc]
            image, alpha = painted[:, :3], painted[:, 3:]
        if raster is None:
            return Painting(image, alpha, segmentation=S)
        painting = Painting(image, alpha, raster.features, raster.alpha, S, gaussians)
        return self.as_taken(painting, camera_index)

    def as_taken(self, painting: Painting, camera_index: Tensor | None) -> Painting:
        """The painting in the colours of its cameras."""
        if self.colour is None or camera_index is None or painting.features is None:
            return painting
        assert painting.splat_alpha is not None
        colour = self.colour(painting.features[:, :3], painting.splat_alpha, camera_index)
        image = painting.image
        if self.generator is None:
            image = colour
        elif image is not None and painting.alpha is not None:
            # detached: losses of the corrected colours must not move alpha
            image = self.colour(image, painting.alpha.detach(), camera_index)
        return replace(painting, image=image, corrected=colour)

    def splat(
        self,
        p: Tensor,
        valid: Tensor,
        frames: BoneFrames,
        camera: Camera,
        body: BodyPose | None,
        pose_noise: Tensor | None,
    ) -> Gaussians | None:
        """Ĝ, or None where nothing is splatted."""
        if self.surface is not None:
            with self.stage("surface"):
                return self.surface(_given(body), camera.centre)
        if self.deformation is None:
            return None
        points = self.points(p, valid, frames, body)
        with self.stage("Ψ"):
            face = face_code(p, frames.head, self.template)
            given = points, camera.centre, frames.hubs[:, 0], pose_noise, face
            return self.deformation(p, *given)  # Sec. 3.3: Ĝ = G + Ψ(p)

    def points(self, p: Tensor, valid: Tensor, frames: BoneFrames, body: BodyPose | None) -> Points:
        """G: Alg. 1's points, or points on the body's surface where that effect is on."""
        with self.stage("densify"):
            if self.body_points is not None:
                return self.body_points(_given(body))
            assert self.densify is not None
            return self.densify(p, valid, frames)

    def bounded(self, gaussians: Gaussians) -> Gaussians:
        """Features clamped to what the generator takes: their blends are then in that range too."""
        bound = getattr(self.generator, "feature_bound", None)
        if bound is None:
            return gaussians
        return replace(gaussians, features=bounded(gaussians.features, -bound, bound))

    def paint(self, frame: Frame, *, maps: bool = True) -> Painting:
        """The whole image of a dataset's frame: its window painted, background around it; without
        F, S and the Gaussians where ``maps`` is False. A missing body pose is solved."""
        given = (frame.skeleton, frame.visibility, frame.camera, frame.body, frame.camera_index)
        return self._paint(*given, maps=maps)

    def _paint(
        self,
        skeleton: Tensor,
        visibility: Tensor,
        camera: Camera,
        body: BodyPose | None,
        camera_index: Tensor | None = None,
        *,
        maps: bool = True,
    ) -> Painting:
        body = self.body_pose(skeleton, visibility) if body is None else body
        window = self._window(skeleton, camera)
        height = None if window is None else window.picture[0]
        given = skeleton, visibility, camera if window is None else window.camera(camera), body
        painting = self(*given, picture_height=height, camera_index=camera_index)
        painting = painting if maps else painting.only_image()
        if window is None:
            return painting
        with self.stage("paste"):
            return painting.pasted(window)

    def body_pose(self, skeleton: Tensor, visibility: Tensor) -> BodyPose | None:
        """The body pose of skeletons ``[B, J, 3]``, see `Solver.solve`; None if none is needed."""
        if self.solver is None:
            return None
        with self.stage("solve"), full_precision(skeleton):
            return self.solver.solve(skeleton, visibility)

    def window(self, frame: Frame) -> Window | None:
        """The part of a frame's image that holds the person; None means all of it."""
        return self._window(frame.skeleton, frame.camera)

    def _window(self, skeleton: Tensor, camera: Camera) -> Window | None:
        if self.window_margin is None:
            return None
        sides = {"multiple": self.window_multiple, "least": self.window_least}
        margin, near = self.window_margin, self.accuracy.near
        with self.stage("window"), full_precision(skeleton):
            return body_window(skeleton, camera, margin=margin, near=near, **sides)

    def segment(self, body: BodyPose | None, camera: Camera) -> Tensor | None:
        """S, without gradient: it is trained on its own and then frozen."""
        if self.segmentation is None:
            return None
        with self.stage("S"), torch.no_grad():
            return self.segmentation(_given(body), camera)

    def draw(self, p: Tensor, valid: Tensor, camera: Camera, picture_height: int | None) -> Tensor:
        """p₂D ``[B, groups, H, W]``, its lines scaled to the whole image's height."""
        share = (picture_height or camera.size[0]) / camera.size[0]
        with self.stage("p₂D"):
            return draw_skeleton(p, valid, camera, self.template, LINE_WIDTH * share)

    def pose_inputs(
        self, p: Tensor, valid: Tensor, frames: BoneFrames, camera: Camera
    ) -> tuple[Tensor, Tensor]:
        """Ω ``[B, J, 6]``; root-centred joints in camera axes, in body heights, and `face_code`."""
        with self.stage("Ω"):
            root = root_of(p, self.template).unsqueeze(1)
            in_camera = (p - root) @ camera.R.mT / self.body_height
            if (face := face_code(p, frames.head, self.template)) is not None:
                in_camera = torch.cat([in_camera[:, : -face.shape[1]], face], dim=1)
            return omega(p, valid, camera.R, self.template, frames=frames), in_camera


def _given(body: BodyPose | None) -> BodyPose:
    if body is None:
        raise ValueError("Avatar: this model was built on a skinned body; give its body pose")
    return body
