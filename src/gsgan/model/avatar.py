"""The avatar: skeleton and camera in, image out."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from gsgan.body.solve import Solver
from gsgan.effects import Effects
from gsgan.model.body_points import BodyPoints
from gsgan.model.colour import ColourCorrection
from gsgan.model.deformation import Deformation
from gsgan.model.generator import ImageGenerator
from gsgan.model.painted import find_window
from gsgan.model.pose_graph import pose_inputs
from gsgan.model.rendering import Rendering
from gsgan.model.residual_gaussians import (
    ResidualGaussians,
    Residuals,
    clamp_soft,
)
from gsgan.model.segmentation import Segmentation
from gsgan.model.surface import SurfaceGaussians
from gsgan.scene import (
    BodyPose,
    Camera,
    Gaussians,
    Raster,
    Window,
    body_window,
    cat,
)
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
    root_of,
)
from gsgan.skeleton.training_poses import TrainingPoses
from gsgan.splat import Accuracy, rasterise
from gsgan.utils.tensors import fill, full_precision

LINE_WIDTH = 2.5  # sigma of p₂D's lines, pixels in an image 512 high
# entering it costs next to nothing
UNWATCHED: AbstractContextManager[None] = nullcontext()


def watch_nothing(stage: str) -> AbstractContextManager[None]:
    """The context of a stage while no bench times it."""
    return UNWATCHED


class Prepared(NamedTuple):
    """The inputs of an avatar, with the values that are found before anything is rendered.

    Args:
        skeleton: ``[B, J, 3]`` metres, world, finite.
        visibility: ``[B, J]`` in [0, 1].
        camera: B cameras, which see the window alone.
        body: B poses of the skinned body; None where none is needed.
        camera_index: ``[B]`` cameras whose colours to correct for, or None.
        window: the part of the images that is rendered; None where the cameras stayed as given.
    """

    skeleton: Tensor
    visibility: Tensor
    camera: Camera
    body: BodyPose | None
    camera_index: Tensor | None
    window: Window | None

    def to(self, device: torch.device) -> Prepared:
        """The inputs on another device."""
        index = self.camera_index
        return Prepared(
            skeleton=self.skeleton.to(device),
            visibility=self.visibility.to(device),
            camera=self.camera.to(device),
            body=None if self.body is None else self.body.to(device),
            camera_index=None if index is None else index.to(device),
            window=self.window,
        )


class PosedPerson(NamedTuple):
    """Poses and what is computed once of them for all parts of an avatar.

    Args:
        p: ``[B, J, 3]`` metres, world, finite.
        valid: ``[B, J]`` bool, the joints that were seen.
        frames: of the bones; None where nothing reads them.
        body: B poses of the skinned body, with the transforms of its bones; None where none is
            needed.
    """

    p: Tensor
    valid: Tensor
    frames: BoneFrames | None
    body: BodyPose | None


class GeneratorInputs(NamedTuple):
    """The inputs of the generator besides F.

    Args:
        S: ``[B, classes, H, W]`` probabilities, or None.
        drawn: ``[B, groups, H, W]`` p₂D.
        pose: Ω and the joints, see `pose_inputs`.
    """

    S: Tensor | None
    drawn: Tensor
    pose: tuple[Tensor, Tensor]


class Avatar(nn.Module):
    """One person: Gaussians, segmentation, pose code and generator.

    `gsgan.run.assemble` builds the parts; `gsgan.load` loads a trained avatar. Call an avatar to
    train or score it, and its `render` for an image.

    Args:
        effects: decided when training began.
        accuracy: the rasteriser's settings for F.
        template: of the skeletons that drive it.
        limb_length_sum: metres, the subject's summed limb lengths.
        stature: metres, the subject's stature: the length scale of the networks' inputs.
        deformation: Ψ; with it either densify (Alg. 1) or body_points places G.
        surface: Gaussians on the body's surface, in place of Ψ (``lbs_splat``).
        segmentation: S, or None (``wo_seg``); segmentation_why says where its labels come from, or
            why there is none.
        pose_encoder, generator: None in ``splat_only``, where Step I's colour is the image.
        colour: per-camera colour correction, where that effect is on.
        solver: of body poses that are not given, for avatars on a skinned body.
        poses: the spread of the training poses, or None.
        backend: that rasterises F, see `gsgan.splat.rasterise`.
        window_margin, window_multiple, window_minimum: of the rendered window, metres and pixels;
            see `gsgan.scene.body_window`. No margin renders whole images.
        generator_margin: pixels round what is splatted that the generator paints, on the CPU and
            not in training; None paints the whole window.

    Source: paper Fig. 3 and Sec. 3.
    """

    # Replaced by benches: the context in which each stage runs, by its name.
    stage: Callable[[str], AbstractContextManager[None]] = staticmethod(
        watch_nothing
    )

    def __init__(
        self,
        *,
        effects: Effects,
        accuracy: Accuracy,
        limb_length_sum: float,
        stature: float,
        template: SkeletonTemplate = MEDIAPIPE33,
        deformation: ResidualGaussians | None = None,
        densify: Densify | None = None,
        body_points: BodyPoints | None = None,
        surface: SurfaceGaussians | None = None,
        segmentation: Segmentation | None = None,
        segmentation_why: str = "",
        pose_encoder: nn.Module | None = None,
        generator: ImageGenerator | None = None,
        colour: ColourCorrection | None = None,
        solver: Solver | None = None,
        poses: TrainingPoses | None = None,
        backend: str = "auto",
        window_margin: float | None = 0.25,
        window_multiple: int = 16,
        window_minimum: int = 32,
        generator_margin: int | None = 8,
    ) -> None:
        super().__init__()

        # Settings of the rendering.
        self.effects = effects
        self.accuracy = accuracy
        self.backend = backend
        self.limb_length_sum = limb_length_sum
        self.stature = stature
        self.template = template
        self.window_margin = window_margin
        self.window_multiple = window_multiple
        self.window_minimum = window_minimum
        self.generator_margin = generator_margin

        # Parts of Step I: G, Ψ or the surface's Gaussians.
        self.deformation = deformation
        self.densify = densify
        self.body_points = body_points
        self.surface = surface

        # Parts of Step II: S, the pose code and the image.
        self.segmentation = segmentation
        self.segmentation_why = segmentation_why
        self.pose_encoder = pose_encoder
        self.generator = generator

        # Parts that are not networks of the paper.
        self.colour = colour
        self.solver = solver
        self.poses = poses

    @property
    def splats(self) -> ResidualGaussians | SurfaceGaussians | None:
        """The part that makes Gaussians and learns in Step I."""
        return self.deformation or self.surface

    @property
    def rest_points(self) -> Tensor:
        """``[N, 3]`` G at rest, in body heights, of an avatar with Ψ."""
        points = self.body_points or self.densify
        assert points is not None
        return points.rest_points

    @property
    def splat_channels(self) -> int:
        """Channels of F, colour included; 0 where nothing is splatted."""
        if self.deformation is not None:
            return 3 + self.deformation.active_features
        return 0 if self.surface is None else 3 + self.surface.features

    @property
    def needs_body(self) -> bool:
        """Whether parts move with a skinned body, whose pose is given or solved."""
        return self.solver is not None

    def freeze(self) -> Self:
        """Ends training and speeds up rendering: what depends on weights alone is computed once.

        Images are the same up to rounding, and follow weights that are loaded later.
        Weights get no gradient; skeleton and camera do.
        """
        self.eval().requires_grad_(False)
        if self.generator is None and self.deformation is not None:
            self.deformation.active_features = 0

        # Every part gets a store, in which `gsgan.utils.tensors.derive` keeps its results.
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

        The image stays on the avatar's device. Inputs are best left on the CPU: the
        body is solved there while a GPU still renders the image before.

        Args:
            skeleton: ``[J, 3]`` or ``[B, J, 3]`` metres, world frame; NaN for joints not seen. An
                avatar with hands and face takes skeletons without: they are not seen. One without
                leaves them out.
            camera: B cameras, or one for all.
            visibility: ``[J]`` or ``[B, J]`` in [0, 1]; 0 marks a stand-in; None: all seen.
            body: B poses of the skinned body; None: solved from the skeleton where it is needed.
            background: RGB in [0, 1], or one number for all three.

        Raises:
            ValueError: on wrong shapes, or when too few shoulders and hips are finite.
        """
        # Joints that were not seen are replaced, on the CPU.
        visibility = None if visibility is None else visibility.cpu()
        height = self.limb_length_sum
        p, seen = complete_skeleton(
            skeleton.cpu(), visibility, self.template, height
        )

        # One camera serves all skeletons.
        if len(camera) not in (1, len(p)):
            raise ValueError(
                f"render: expected 1 or {len(p)} cameras, got {len(camera)}"
            )
        cameras = camera if len(camera) == len(p) else cat([camera] * len(p))

        # The image, which is on black, gets the requested background.
        rendering = self(p, seen, cameras.to("cpu"), body, maps=False)
        assert rendering.image is not None
        assert rendering.alpha is not None
        colour = fill(background, rendering.image).expand(3).view(1, 3, 1, 1)
        image = rendering.image.clamp(0, 1)
        return (image + (1 - rendering.alpha.clamp(0, 1)) * colour).clamp(0, 1)

    def forward(
        self,
        skeleton: Tensor,
        visibility: Tensor,
        camera: Camera,
        body: BodyPose | None = None,
        camera_index: Tensor | None = None,
        *,
        pose_noise: Tensor | None = None,
        generate: bool = True,
        maps: bool = True,
        supersample: bool = True,
        reach: float | None = None,
    ) -> Rendering:
        """Renders poses: I_pred and every map that led to it.

        A window round the person is rendered, and pasted into the whole image. Cameras
        that see a window already (`Window.camera`) are rendered as they are. Inputs may be on the
        CPU: body and window are then found there, and nothing is read back from the avatar's
        device.

        Args:
            skeleton: ``[B, J, 3]`` metres, world, finite: `gsgan.skeleton.sanitise` replaces joints
                that were not seen.
            visibility: ``[B, J]`` in [0, 1]; 0 marks a stand-in.
            camera: B cameras.
            body: B poses of the skinned body; None: solved where it is needed.
            camera_index: ``[B]`` cameras whose colours to correct for; None corrects nothing.
            pose_noise: ``[B, J, 3]`` added to Ψ's pose code, in its units (training only).
            generate: False stops after F (Step I needs no more).
            maps: False returns image and alpha alone.
            supersample: False draws F once per pixel, whatever ``accuracy`` says.
            reach: metres; Ψ is not computed at points farther than this from what the cameras
                see. None computes it at all points.
        """
        # The body and the window need values, so they are found before the transfer to the device.
        device = next(self.parameters()).device
        prepared = self.prepare(
            skeleton, visibility, camera, body, camera_index
        )
        rendering, painted = self._render(
            prepared.to(device),
            pose_noise=pose_noise,
            generate=generate,
            supersample=supersample,
            reach=reach,
        )

        # The part of the whole image that was rendered.
        window = prepared.window
        if painted is not None:
            window = painted if window is None else painted.within(window)

        # Image and maps in the whole image.
        rendering = rendering if maps else rendering.only_image()
        if window is None:
            return rendering
        with self.stage("paste"):
            return rendering.paste(window)

    def prepare(
        self,
        skeleton: Tensor,
        visibility: Tensor,
        camera: Camera,
        body: BodyPose | None,
        camera_index: Tensor | None,
    ) -> Prepared:
        """What is rendered, on the device of the inputs; arguments as for `forward`."""
        # The window crops the cameras, so that only the part with the person is drawn.
        body = self.body_pose(skeleton, visibility) if body is None else body
        window = self.window(skeleton, camera)
        seen = camera if window is None else window.camera(camera)
        return Prepared(skeleton, visibility, seen, body, camera_index, window)

    def body_pose(
        self, skeleton: Tensor, visibility: Tensor
    ) -> BodyPose | None:
        """The body pose of skeletons ``[B, J, 3]``, see `Solver.solve`; None if none is needed."""
        if self.solver is None:
            return None
        with self.stage("solve"), full_precision(skeleton.device):
            return self.solver.solve(skeleton, visibility)

    def window(self, skeleton: Tensor, camera: Camera) -> Window | None:
        """The part of the images that holds the person; None means all of what the cameras see."""
        if self.window_margin is None or camera.whole_height is not None:
            return None

        # The window's sides suit the generator's stride.
        sides = {
            "multiple": self.window_multiple,
            "minimum": self.window_minimum,
        }
        margin = self.window_margin
        near = self.accuracy.near
        with self.stage("window"), full_precision(skeleton.device):
            return body_window(
                skeleton, camera, margin=margin, near=near, **sides
            )

    def _render(
        self,
        prepared: Prepared,
        *,
        pose_noise: Tensor | None,
        generate: bool,
        supersample: bool,
        reach: float | None,
    ) -> tuple[Rendering, Window | None]:
        """The drawings and images that the cameras see (paper Fig. 3).

        The window is the part of the cameras' images that these show; None means all.
        """
        camera = prepared.camera
        camera_index = prepared.camera_index
        raster = S = image = alpha = painted = None
        with full_precision(camera.K.device):
            posed = self._pose(
                prepared.skeleton, prepared.visibility > 0, prepared.body
            )

            # Step I's part: Ĝ and its splatted features F.
            gaussians = self.splat(posed, camera, pose_noise, reach)
            if gaussians is not None:
                raster = self._rasterise(gaussians, camera, supersample)

            # The generator paints where something was splatted, and has other inputs.
            if generate and self.generator is not None:
                painted = None if raster is None else self._find_window(raster)
                if painted is not None and raster is not None:
                    raster = painted.raster(raster)
                    camera = painted.camera(camera)
                inputs = self._generator_inputs(posed, camera)

        # Sec. 3.5: the pose code and the UNet run in the precision of the trainer.
        if generate and self.generator is not None:
            S = inputs.S
            generated = self._generate(inputs, raster).to(posed.p.dtype)
            image = generated[:, :3]
            alpha = generated[:, 3:]

        # Nothing is splatted in image_to_image.
        if raster is None:
            return Rendering(image, alpha, segmentation=S), None

        # Step I's colour is the image where there is no generator.
        if self.generator is None:
            image = raster.features[:, :3]
            alpha = raster.alpha
        rendering = Rendering(
            image, alpha, raster.features, raster.alpha, S, gaussians
        )

        # Step I's colour and I_pred take on the tint of the training camera.
        if self.colour is not None and camera_index is not None:
            rendering = self._correct_colours(
                rendering, raster, self.colour, camera_index
            )
        return rendering, painted

    def _pose(
        self, p: Tensor, valid: Tensor, body: BodyPose | None
    ) -> PosedPerson:
        """Poses with the frames and bones that the avatar's parts read."""
        # Densify, the face code and Ω read the frames of the skeleton's bones.
        frames = None
        if (
            self.densify is not None
            or self.generator is not None
            or self.template.expression
        ):
            with self.stage("skeleton"):
                frames = bone_frames(p, valid, self.template)

        # The body's bones are computed once for G and S.
        follows = self.body_points or self.surface or self.segmentation
        if body is not None and follows is not None:
            with self.stage("bones"):
                body = follows.points.with_bones(body)
        return PosedPerson(p, valid, frames, body)

    def _generator_inputs(
        self, posed: PosedPerson, camera: Camera
    ) -> GeneratorInputs:
        """The inputs of the generator besides F."""
        S = None
        if self.segmentation is not None:
            # trained on its own, then frozen
            with self.stage("S"), torch.no_grad():
                S = self.segmentation(posed.body, camera)  # Sec. 3.4
        with self.stage("p₂D"):
            drawn = draw_skeleton(
                posed.p,
                posed.valid,
                camera,
                self.template,
                line_width(camera),
            )
        with self.stage("Ω"):
            assert posed.frames is not None
            pose = pose_inputs(
                posed.p,
                posed.valid,
                posed.frames,
                camera,
                self.template,
                self.stature,
            )
        return GeneratorInputs(S, drawn, pose)

    def _generate(
        self, inputs: GeneratorInputs, raster: Raster | None
    ) -> Tensor:
        """``[B, 4, H, W]`` I_pred and its alpha."""
        assert self.generator is not None
        assert self.pose_encoder is not None
        with self.stage("pose encoder"):
            g = self.pose_encoder(*inputs.pose)
        with self.stage("UNet"):
            # image_to_image: the drawing stands in F's place
            if raster is None:
                return self.generator(F=inputs.drawn, S=inputs.S, p2d=None, g=g)
            return self.generator(
                F=raster.features,
                S=inputs.S,
                p2d=inputs.drawn,
                g=g,
                fine=raster.fine,
                alpha=raster.alpha,
            )

    def _find_window(self, raster: Raster) -> Window | None:
        """The part of the images that the generator paints; None means all.

        On a GPU this is all, since reading the part would make the host wait; in training too, for
        the losses compare whole windows.
        """
        if (
            self.generator is None
            or self.generator_margin is None
            or self.training
            or raster.alpha.device.type != "cpu"
            or torch.compiler.is_compiling()
        ):
            return None
        return find_window(
            raster.alpha,
            margin=self.generator_margin,
            multiple=self.window_multiple,
        )

    def splat(
        self,
        posed: PosedPerson,
        camera: Camera,
        pose_noise: Tensor | None = None,
        reach: float | None = None,
    ) -> Gaussians | None:
        """Ĝ, or None where nothing is splatted.

        Features are clamped to what the generator takes: their blends are then in that range too.
        """
        if self.surface is not None:
            # The baseline's Gaussians follow the body and need no residuals.
            with self.stage("surface"):
                gaussians = self.surface(posed.body, camera.centre)
        elif self.deformation is not None:
            # Points far from what the cameras see are left out, which saves time in training.
            points = self.points(posed)
            chosen = None
            if reach is not None:
                chosen = select_visible(points.means, camera, reach)
            with self.stage("Ψ"):  # Sec. 3.3: Ĝ = G + Ψ(p)
                gaussians = self.deformation(
                    posed.p,
                    points,
                    camera.centre,
                    pose_noise,
                    self._face_code(posed),
                    chosen,
                )
        else:
            return None

        # The bound of the features is the generator's, so there is none without a generator.
        bound = None if self.generator is None else self.generator.feature_bound
        if bound is None:
            return gaussians  # type: ignore[no-any-return]
        return replace(
            gaussians, features=clamp_soft(gaussians.features, -bound, bound)
        )

    def _face_code(self, posed: PosedPerson) -> Tensor | None:
        """`face_code`; None for a skeleton without a face."""
        if posed.frames is None:
            return None
        return face_code(posed.p, posed.frames.head, self.template)

    def points(self, posed: PosedPerson) -> Points:
        """G: Alg. 1's points, or points on the body's surface where that effect is on."""
        with self.stage("densify"):
            if self.body_points is not None:
                return self.body_points(posed.body)  # type: ignore[no-any-return]
            assert self.densify is not None
            return self.densify(posed.p, posed.valid, posed.frames)  # type: ignore[no-any-return]

    def residuals(
        self, p: Tensor, valid: Tensor, body: BodyPose | None
    ) -> tuple[Points, Residuals]:
        """G in pose and Ψ's ΔG without noise; arguments as for `PosedPerson`."""
        assert self.deformation is not None
        posed = self._pose(p, valid, body)
        points = self.points(posed)
        code = self._code(posed)
        return points, self.deformation.residuals(points, code, root_of(p))

    def _code(self, posed: PosedPerson) -> Tensor:
        """``[B, 3 J]`` Ψ's code of poses, without noise."""
        assert self.deformation is not None
        face = self._face_code(posed)
        return self.deformation.pose_code(posed.p, root_of(posed.p), None, face)

    @torch.no_grad()
    def store_poses(
        self, p: Tensor, valid: Tensor, body: BodyPose | None
    ) -> None:
        """Stores the spread of training poses in Ψ; arguments as for `PosedPerson`."""
        if isinstance(self.deformation, Deformation):
            # The means give the places of the anchors in the training poses.
            posed = self._pose(p, valid, body)
            means = self.points(posed).means
            self.deformation.store_poses(self._code(posed), means, root_of(p))

    def _rasterise(
        self, gaussians: Gaussians, camera: Camera, supersample: bool
    ) -> Raster:
        """F."""
        with self.stage("F"):
            return rasterise(
                gaussians,
                camera,
                settings=self.accuracy
                if supersample
                else replace(self.accuracy, supersample=1),
                backend=self.backend,
            )

    def _correct_colours(
        self,
        rendering: Rendering,
        raster: Raster,
        correction: ColourCorrection,
        camera_index: Tensor,
    ) -> Rendering:
        """The rendering in the colours of its cameras."""
        # Step I's colour, corrected with its own alpha.
        colour = correction(raster.features[:, :3], raster.alpha, camera_index)

        # The image is either the same colour or the generator's, which has an alpha of its own.
        image = rendering.image
        if self.generator is None:
            image = colour
        elif image is not None and rendering.alpha is not None:
            # detached: losses of the corrected colours must not move alpha
            image = correction(image, rendering.alpha.detach(), camera_index)
        return replace(rendering, image=image, corrected=colour)


@torch.no_grad()
def select_visible(means: Tensor, camera: Camera, reach: float) -> Tensor:
    """``[B, M]`` numbers of the points ``[B, N, 3]`` that are within reach of what a camera sees.

    Items with fewer than M such points have others as well.

    Args:
        means: metres.
        camera: B cameras.
        reach: metres round the part of space that an image shows.
    """
    # Places of the points in the image.
    height, width = camera.size
    pixels, depth = camera.project(means)

    # The reach in pixels at each point's depth. A depth below the reach counts as the reach.
    focal = camera.focal
    beyond = reach * focal[:, None] / depth.clamp_min(reach).unsqueeze(-1)

    # Points within the image and the margin round it.
    size = pixels.new_tensor([width, height])
    inside = ((pixels >= -beyond) & (pixels <= size + beyond)).all(-1)

    # All items have as many points as the one with most; the stable sort puts these first.
    count = int(inside.sum(1).max().clamp_min(1))
    return (
        inside.byte()
        .sort(dim=1, descending=True, stable=True)
        .indices[:, :count]
    )


def line_width(camera: Camera) -> float:
    """Sigma of p₂D's lines in pixels; in a window as in the whole image."""
    height = camera.size[0]
    return LINE_WIDTH * ((camera.whole_height or height) / height)
