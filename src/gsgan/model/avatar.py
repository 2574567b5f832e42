"""The avatar: skeleton and camera in, picture out; its forward reads like the paper's figure."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor, nn

from gsgan.body import open_body
from gsgan.effects import Effects, EffectSettings, decide
from gsgan.model.body_points import BodyPoints
from gsgan.model.class_vote import ClassVote, Pictures
from gsgan.model.colour import ColourCorrection
from gsgan.model.deformation import Deformation
from gsgan.model.generator import Generator
from gsgan.model.painting import Painting
from gsgan.model.parts import labelled_body
from gsgan.model.segmentation import Segmentation
from gsgan.model.surface import SurfaceGaussians
from gsgan.scene import BodyPose, Camera, Frame, Gaussians
from gsgan.skeleton import (
    MEDIAPIPE33,
    BoneFrames,
    Densify,
    Points,
    bone_frames,
    draw_skeleton,
    omega,
    root_of,
)
from gsgan.splat import BACKENDS, Accuracy, rasterise
from gsgan.splat.checks import checks_for
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.precision import full_precision
from gsgan.window import Window, body_window

if TYPE_CHECKING:
    from gsgan.data.datamodule import SceneInfo  # loads Lightning

LINE_WIDTH = 2.5  # sigma of p₂D's lines, pixels in a picture 512 high
SKELETON_CHANNELS = len(MEDIAPIPE33.draw_groups)
UNWATCHED: AbstractContextManager[None] = nullcontext()  # entering it costs next to nothing


def unwatched(stage: str) -> AbstractContextManager[None]:
    """What a stage of painting runs in while no bench times it."""
    return UNWATCHED


class Avatar(nn.Module):
    """One person: Gaussians, segmentation, pose code and generator put together.

    Parts whose sizes depend on the scene arrive as functions of those sizes (``_partial_`` in the
    config), so each config file names one constructor per part.

    Args:
        scene: what the training data is like: body height, whether it has a body pose.
        densify: skeleton to points.
        deformation: Ψ, given rest points, body height and number of joints. None, like densify,
            in the baselines that have no Ψ.
        surface: in place of Ψ, Gaussians on the body's surface, given the body (``lbs_splat``).
            Without either nothing is splatted, and the UNet paints the drawn skeleton alone
            (``image_to_image``).
        body_points: in densify's place where that effect is on, given the body and its height.
        segmentation: S, given a body; None leaves it out (``wo_seg``).
        pose_encoder: Ω (or the flat skeleton) to g; None in ``splat_only``.
        generator: the UNet, given its channel counts; None makes Step I's colour the picture.
        accuracy: the rasteriser's settings for F.
        low_pass: square pixels, of the picture as drawn, that F and S add to every ellipse.
        supersample: F is drawn so many times larger each way and averaged.
        backend: who rasterises F and S, see `gsgan.splat.rasterise`.
        twist: how bone frames turn about their bones, ``none`` or ``hinge``.
        window_margin: metres round the joints that are painted; None paints whole pictures.
        window_multiple: the window's sides are multiples of so many pixels.
        window_least: pixels, its shortest side (a discriminator cannot judge less).
        class_vote: gives S's vertices their parts where the data's labels are not the body's own;
            None votes with its own settings.
        pictures: training frames with labels, for that vote.
        vertex_labels: ``[V]`` int64, the outcome of an earlier vote, which then is not held again.
        labelled: whether S was trained on part labels; None: whether the data has some.
        effects: what the scene calls for; None decides it here, with the settings' defaults. Those
            that this model cannot have are taken out.

    Source: paper Fig. 3 and Sec. 3.
    """

    # Exchanged by benches: what each stage runs in, by its name.
    stage: Callable[[str], AbstractContextManager[None]] = staticmethod(unwatched)

    def __init__(
        self,
        scene: SceneInfo,
        densify: Densify | None,
        deformation: Callable[..., Deformation] | None,
        segmentation: Callable[..., Segmentation] | None,
        pose_encoder: nn.Module | None,
        generator: Callable[..., Generator] | None,
        accuracy: Accuracy,
        surface: Callable[..., SurfaceGaussians] | None = None,
        body_points: Callable[..., BodyPoints] | None = None,
        low_pass: float = 0.3,
        supersample: int = 1,
        backend: str = "auto",
        twist: Literal["none", "hinge"] = "none",
        window_margin: float | None = 0.25,
        window_multiple: int = 16,
        window_least: int = 32,
        class_vote: ClassVote | None = None,
        pictures: Pictures | None = None,
        vertex_labels: Tensor | None = None,
        labelled: bool | None = None,
        effects: Effects | None = None,
    ) -> None:
        super().__init__()
        _check_accuracy(accuracy)
        if densify is not None and densify.template is not MEDIAPIPE33 and twist != "none":
            raise ValueError("twist=hinge goes with densify.limbs=paper22 only")
        self.effects = decide(scene, EffectSettings()) if effects is None else effects
        self.effects = _possible(self.effects, densify is not None, surface is not None)
        if backend not in BACKENDS:
            raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
        self.low_pass, self.backend = low_pass, backend
        self.accuracy = replace(self._image_formation(accuracy), supersample=supersample)
        self.template, self.twist = MEDIAPIPE33, twist
        self.window_margin = window_margin
        self.window_multiple, self.window_least = window_multiple, window_least
        self.limb_sum = float(scene.body_height)
        # Stature, from limb lengths: what the skeleton measures and no pose changes.
        self.body_height = self.limb_sum * self.template.stature / self.template.limb_length_sum
        # Each part draws from a seed of its own: leaving one out does not change the others' start.
        seed = torch.initial_seed()
        torch.manual_seed(seed + 1)
        self.deformation: Deformation | None = None
        self.densify: Densify | None = None
        self.body_points: BodyPoints | None = None
        if (deformation is None) != (densify is None):
            raise ValueError("Avatar: densify and deformation go together; got only one of them")
        if densify is not None and deformation is not None:
            if surface is not None:
                raise ValueError("Avatar: give a deformation or a surface, got both")
            self.body_points = self._build_body_points(scene, body_points)
            if self.body_points is None:
                self.densify = densify
            self.deformation = deformation(
                rest_points=(self.body_points or densify).rest_points,
                body_height=self.body_height,
                joints=len(self.template.names),
                sh_degree=self.effects.degree,
            )
        self.surface = self._build_surface(scene, surface)
        if self.splats is None and generator is None:
            raise ValueError("Avatar: nothing paints; give a deformation, a surface or a generator")
        self.segmentation = self._build_segmentation(
            scene, segmentation, class_vote or ClassVote(), pictures, vertex_labels, labelled
        )
        self.pose_encoder = pose_encoder
        self.generator: Generator | None = None
        if (generator is None) != (pose_encoder is None):
            raise ValueError("Avatar: generator and pose_encoder go together; got only one of them")
        torch.manual_seed(seed + 2)
        if generator is not None and pose_encoder is not None:
            self.generator = generator(
                feature_channels=self.splat_channels or SKELETON_CHANNELS,
                segmentation_channels=self.segmentation.classes if self.segmentation else 0,
                skeleton_channels=SKELETON_CHANNELS if self.splats else 0,
                pose_channels=pose_encoder.channels,
                supersample=self.accuracy.supersample if self.splat_channels else 1,
            )
        self.colour: ColourCorrection | None = None
        if self.effects.colour_correction.on:
            self.colour = ColourCorrection(self.effects.cameras, scene.camera_names)

    @property
    def splats(self) -> Deformation | SurfaceGaussians | None:
        """The part that makes Gaussians and learns in Step I."""
        return self.deformation or self.surface

    @property
    def splat_channels(self) -> int:
        """Channels of F, colour included; 0 where nothing is splatted."""
        return 0 if self.splats is None else 3 + self.splats.features

    def _build_surface(
        self, scene: SceneInfo, build: Callable[..., SurfaceGaussians] | None
    ) -> SurfaceGaussians | None:
        if build is None:
            return None
        body = None
        if scene.has_body_pose:
            body = open_body(scene.body, scene.body_file, scene.betas, scene.label_names)
        if body is None:
            raise DataError(
                "model.surface: Gaussians on the body need a body pose for every frame and the "
                "body's mesh, and this data lacks one; choose model=splat_only or model=full"
            )
        degree = self.effects.degree
        return build(body=body, body_height=self.body_height, sh_degree=degree)

    def _build_body_points(
        self, scene: SceneInfo, build: Callable[..., BodyPoints] | None
    ) -> BodyPoints | None:
        if build is None:
            self.effects = self.effects.without("body_points", "the model leaves them out")
        if build is None or not self.effects.body_points.on:
            return None
        body = open_body(scene.body, scene.body_file, scene.betas)
        if body is None:
            why = (
                f"the data's poses are of the body {scene.body!r}, of which there is no model file"
            )
            self.effects = self.effects.without("body_points", why)
            return None
        return build(body=body, body_height=self.body_height)

    def _build_segmentation(
        self,
        scene: SceneInfo,
        build: Callable[..., Segmentation] | None,
        vote: ClassVote,
        pictures: Pictures | None,
        vertex_labels: Tensor | None,
        labelled: bool | None,
    ) -> Segmentation | None:
        self.segmentation_why = "the model leaves it out"
        if build is None:
            return None
        body, self.segmentation_why = labelled_body(scene, vote, pictures, vertex_labels)
        if body is None:
            return None
        built = build(body=body, labelled=scene.has_labels if labelled is None else labelled)
        built.accuracy, built.backend = self._image_formation(built.accuracy), self.backend
        return built

    def _image_formation(self, accuracy: Accuracy) -> Accuracy:
        """How pixels are formed is the model's and the scene's, whatever may be left out."""
        return replace(
            accuracy,
            low_pass=self.low_pass,
            antialias=self.effects.antialias.on,
        )

    def forward(
        self,
        skeleton: Tensor,
        visibility: Tensor,
        camera: Camera,
        body: BodyPose | None = None,
        *,
        pose_noise: Tensor | None = None,
        paint: bool = True,
        detach_features: bool = False,
        picture_height: int | None = None,
        camera_index: Tensor | None = None,
    ) -> Painting:
        """Paints the pose.

        Args:
            skeleton: ``[B, J, 3]`` metres, world, finite: see `gsgan.skeleton.sanitise` for joints
                that were not seen, which the data module stands in for when it opens a capture.
            visibility: ``[B, J]`` in [0, 1]; 0 marks a stand-in.
            camera: B cameras.
            body: pose of the skinned body; needed when S was built.
            pose_noise: ``[B, J, 3]`` body heights, added to Ψ's pose code (training only).
            paint: False stops after F (Step I needs no more).
            detach_features: keep Step II's gradient out of Ψ.
            picture_height: pixels of the whole picture, when ``camera`` sees a window of it: the
                drawn skeleton's lines are as wide as they would be there.
            camera_index: ``[B]`` which cameras these are, for their colours; None corrects none.

        Returns:
            I_pred with all that led to it.
        """
        paints = paint and self.generator is not None
        with full_precision(skeleton):
            with self.stage("skeleton"):
                p, valid = skeleton, visibility > 0
                frames = bone_frames(p, valid, self.template, twist=self.twist)

            gaussians = self.splat(p, valid, frames, camera, body, pose_noise)
            raster = None
            if gaussians is not None:
                with self.stage("F"):
                    raster = rasterise(
                        gaussians,
                        camera,
                        settings=self.accuracy,
                        backend=self.backend,
                        on_invalid=checks_for(skeleton.device),
                    )
            S = self.segment(body, camera) if paints else None  # Sec. 3.4
            p2d = self.draw(p, valid, camera, picture_height) if paints else None
            pose = self.pose_inputs(p, valid, frames, camera) if paints else None

        F = None if raster is None else raster.features
        image = alpha = None
        if self.generator is None and raster is not None:
            image, alpha = raster.features[:, :3], raster.alpha
        if paints:  # Sec. 3.5
            with self.stage("pose encoder"):
                g = self.pose_encoder(*pose)  # type: ignore[misc]
            with self.stage("UNet"):
                if raster is None:  # image_to_image: the drawing stands in F's place
                    inputs = (p2d, S, None, g)
                else:
                    seen = (raster.features, raster.fine, raster.alpha)
                    if detach_features:
                        seen = tuple(None if x is None else x.detach() for x in seen)  # type: ignore[assignment]
                    inputs = (seen[0], S, p2d, g, *seen[1:])  # type: ignore[assignment]
                painted = self.generator(*inputs).to(skeleton.dtype)  # type: ignore[misc]
            image, alpha = painted[:, :3], painted[:, 3:]
        if raster is None:
            return Painting(image, alpha, segmentation=S)
        painting = Painting(image, alpha, F, raster.alpha, S, gaussians)
        return self.as_taken(painting, camera_index)

    def as_taken(self, painting: Painting, camera_index: Tensor | None) -> Painting:
        """The painting in the colours of its cameras: the one place where they are corrected."""
        if self.colour is None or camera_index is None or painting.features is None:
            return painting
        assert painting.splat_alpha is not None
        colour = self.colour(painting.features[:, :3], painting.splat_alpha, camera_index)
        image = painting.image
        if self.generator is None:
            image = colour
        elif image is not None and painting.alpha is not None:
            # detached: losses of the corrected colours are not to move alpha
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
            if body is None:
                raise ValueError("Avatar: this model's Gaussians sit on the body; give its pose")
            with self.stage("surface"):
                return self.surface(body, camera.centre)
        if self.deformation is None:
            return None
        with self.stage("densify"):
            points = self.place(p, valid, frames, body)
        with self.stage("Ψ"):
            return self.deformation(  # Sec. 3.3: Ĝ = G + Ψ(p)
                p, points, camera.centre, frames.hubs[:, 0], pose_noise
            )

    def place(self, p: Tensor, valid: Tensor, frames: BoneFrames, body: BodyPose | None) -> Points:
        """G: on the body's surface where this scene has one that fits, else by Alg. 1."""
        if self.body_points is not None:
            if body is None:
                raise ValueError("Avatar: this model's points sit on the body; give its pose")
            return self.body_points(body)
        assert self.densify is not None
        return self.densify(p, valid, frames)

    def paint(self, frame: Frame) -> Painting:
        """The whole picture of a frame of a dataset: its window painted, background around it."""
        window = self.window(frame)
        if window is None:
            return self(
                frame.skeleton,
                frame.visibility,
                frame.camera,
                frame.body,
                camera_index=frame.camera_index,
            )
        painting = self(
            frame.skeleton,
            frame.visibility,
            window.camera(frame.camera),
            frame.body,
            picture_height=window.picture[0],
            camera_index=frame.camera_index,
        )
        with self.stage("paste"):
            return painting.pasted(window)

    def window(self, frame: Frame) -> Window | None:
        """The part of a frame's picture that holds the person; None means all of it."""
        if self.window_margin is None:
            return None
        with self.stage("window"), full_precision(frame.skeleton):
            return body_window(
                frame.skeleton,
                frame.camera,
                margin=self.window_margin,
                multiple=self.window_multiple,
                least=self.window_least,
                near=self.accuracy.near,
            )

    def segment(self, body: BodyPose | None, camera: Camera) -> Tensor | None:
        """S, without gradient: it is trained on its own and then frozen."""
        if self.segmentation is None:
            return None
        if body is None:
            raise ValueError("Avatar: this model was built with S and needs the frame's body pose")
        with self.stage("S"), torch.no_grad():
            return self.segmentation(body, camera)

    def draw(self, p: Tensor, valid: Tensor, camera: Camera, picture_height: int | None) -> Tensor:
        """p₂D ``[B, 8, H, W]``, its lines scaled to the whole picture's height."""
        share = (picture_height or camera.size[0]) / camera.size[0]
        with self.stage("p₂D"):
            return draw_skeleton(p, valid, camera, self.template, LINE_WIDTH * share)

    def pose_inputs(
        self, p: Tensor, valid: Tensor, frames: BoneFrames, camera: Camera
    ) -> tuple[Tensor, Tensor]:
        """Ω ``[B, J, 6]``, and the joints about the root in camera axes and body heights."""
        with self.stage("Ω"):
            root = root_of(p, self.template).unsqueeze(1)
            in_camera = (p - root) @ camera.R.mT / self.body_height
            return omega(p, valid, camera.R, self.template, frames=frames), in_camera


def _check_accuracy(accuracy: Accuracy) -> None:
    """Refuses values of the accuracy that the model and the effects set: they would be lost."""
    for name, place in (
        ("low_pass", "model.low_pass"),
        ("supersample", "model.supersample"),
        ("antialias", "effects.antialias"),
    ):
        if getattr(accuracy, name) != getattr(Accuracy, name):
            raise ConfigError(f"accuracy.{name} is not read; set {place}")


def _possible(effects: Effects, densifies: bool, on_surface: bool) -> Effects:
    """Without the effects on points and Gaussians that this model does not have."""
    if not densifies:
        effects = effects.without("body_points", "this model puts no points on the skeleton")
    if densifies or on_surface:
        return effects
    for name in ("view_dependence", "antialias", "colour_correction", "random_background"):
        effects = effects.without(name, "this model splats nothing")
    return effects
