"""Builds the avatar that a config describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, Self

import torch
from omegaconf import DictConfig
from torch import Tensor
from torch.utils.data import Subset

from gsgan.body import SkinnedBody, open_body
from gsgan.body.skinned import MarkedBody
from gsgan.body.solve import Solver
from gsgan.data.scene_info import SceneInfo
from gsgan.effects import Effects, EffectSettings, ModelParts, decide
from gsgan.effects.record import OFF
from gsgan.model.avatar import Avatar
from gsgan.model.body_points import (
    DENSE,
    BodyPoints,
    BodyPointsSettings,
    points_per_pixel,
)
from gsgan.model.colour import ColourCorrection
from gsgan.model.deformation import DeformationSettings
from gsgan.model.generator import Channels, GeneratorFactory
from gsgan.model.pose_graph import (
    PoseGraph,
    PoseGraphSettings,
    PoseLinear,
    PoseLinearSettings,
)
from gsgan.model.residual_gaussians import PlacedPoints, ResidualSettings
from gsgan.model.segmentation import SegmentationSettings
from gsgan.model.surface import SurfaceGaussians
from gsgan.run.class_vote import label_body
from gsgan.scene import Frame
from gsgan.skeleton import Densify, template_of
from gsgan.splat import BACKENDS, Accuracy
from gsgan.utils.checks import one_of
from gsgan.utils.config import CommandOptions, build
from gsgan.utils.errors import ConfigError, DataError

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData  # loads lightning

OPTIONS = (
    "backend",
    "window_margin",
    "window_multiple",
    "window_minimum",
    "generator_margin",
)  # of `Avatar`
PoseEncoderSettings = PoseGraphSettings | PoseLinearSettings


class SurfaceFactory(Protocol):
    """The key ``model.surface``, which builds Gaussians on a body."""

    def build(
        self, body: SkinnedBody, stature: float, sh_degree: int
    ) -> SurfaceGaussians:
        """The Gaussians on a person's body."""


@dataclass(frozen=True)
class AvatarParts:
    """The config group ``model`` (keys: conf/model/full.yaml).

    Parts whose sizes depend on the scene, or that draw their weights, are settings that build them.

    Args:
        accuracy: the rasteriser's settings for F.
        densify, deformation: skeleton to points; Ψ.
        body_points: in place of densify, if that effect is on.
        surface: in place of Ψ, any Gaussians that move with the body (``lbs_splat``). Without
            either nothing is splatted and the UNet paints the drawn skeleton alone
            (``image_to_image``).
        segmentation: S; None leaves it out (``wo_seg``).
        pose_encoder, generator: Ω (or the flat skeleton) to g; the UNet. Without them Step I's
            colour is the image (``splat_only``).
        low_pass, supersample, backend: of F, and of S as far as it has them.
        window_margin, window_multiple, window_minimum, generator_margin: of `Avatar`.

    Raises:
        ConfigError, ValueError: on parts that do not go together.
    """

    accuracy: Accuracy
    densify: Densify | None
    deformation: ResidualSettings | None
    segmentation: SegmentationSettings | None
    pose_encoder: PoseEncoderSettings | None
    generator: GeneratorFactory | None
    body_points: BodyPointsSettings | None
    low_pass: float
    supersample: int
    backend: str
    window_margin: float | None
    window_multiple: int
    window_minimum: int
    generator_margin: int | None
    surface: SurfaceFactory | None = None  # one model alone has it

    def __post_init__(self) -> None:
        # The experiment sets keys of `densify` in models that have no such part.
        if isinstance(self.densify, Mapping):
            raise ConfigError(
                "experiment=paper changes parts that this model does not have; it goes with "
                "model=full, wo_feat, wo_seg, wo_gcn or splat_only"
            )
        one_of("model.backend", self.backend, BACKENDS)

        # Pairs of parts that need each other.
        if (self.deformation is None) != (self.densify is None):
            raise ValueError("densify and deformation go together")
        if (self.generator is None) != (self.pose_encoder is None):
            raise ValueError("generator and pose_encoder go together")

        # Exactly one source of Gaussians, unless the UNet paints without any.
        if self.deformation and self.surface:
            raise ValueError("give a deformation or a surface, got both")
        if not (self.deformation or self.surface or self.generator):
            raise ValueError(
                "nothing paints; give a deformation, a surface or a generator"
            )

    @property
    def in_effects(self) -> ModelParts:
        """The parts that effects act on."""
        return ModelParts(
            splats=self.densify is not None or self.surface is not None,
            points=self.densify is not None,
            network=isinstance(self.deformation, DeformationSettings),
            body_points=self.body_points is not None,
        )


@dataclass(frozen=True)
class AvatarSettings(CommandOptions):
    """What a config says of an avatar.

    Args:
        model: its parts.
        seed: of their weights.
        effects: requested; a shared avatar's were decided when it was trained.
    """

    model: AvatarParts
    seed: int
    effects: EffectSettings | None = None

    def with_backend(self, backend: str) -> AvatarSettings:
        """The settings with another rasteriser of F and S."""
        return replace(self, model=replace(self.model, backend=backend))

    @property
    def moves_with_body(self) -> bool:
        """Whether parts move with a skinned body, if the data has one."""
        # S and Gaussians on the body always need it; placing G there is an effect.
        model = self.model
        if model.segmentation is not None or model.surface is not None:
            return True
        if model.body_points is None or self.effects is None:
            return False
        return self.effects.value_of("body_points") != OFF


@dataclass(frozen=True)
class RunSettings(CommandOptions):
    """What a run's config says of its avatar, and its data, which is not read yet."""

    avatar: AvatarSettings
    data: GsganData

    @classmethod
    def from_config(cls, config: DictConfig) -> Self:
        """The settings of a config."""
        # Images are undistorted when they are read, so the dataset knows that effect.
        avatar = AvatarSettings.from_config(config)
        effects = avatar.effects
        distortion = (
            "auto" if effects is None else effects.value_of("distortion")
        )
        return cls(avatar, build(config.data, distortion=distortion))


def build_avatar(
    settings: AvatarSettings,
    scene: SceneInfo,
    images: Subset[Frame] | None = None,
    *,
    effects: Effects | None = None,
    vertex_labels: Tensor | None = None,
) -> Avatar:
    """An untrained avatar, its weights from the seed.

    Args:
        settings: its parts.
        scene: facts about the training split.
        images: training frames with part labels, for the class vote.
        effects: decided when training began; None decides them now.
        vertex_labels: ``[V]`` int64, the result of an earlier vote, which is then not repeated.

    Raises:
        ConfigError: on a forced effect that is not possible, or on a value that a part refuses.
        DataError: when the data lacks the body that the model needs.
    """
    parts = settings.model
    with naming_group("model"):
        # Every group of parts draws its weights from a seed of its own.
        torch.manual_seed(settings.seed)
        encoder = None
        if parts.pose_encoder is not None:
            encoder = parts.pose_encoder.build()
        if effects is None:
            assert settings.effects is not None
            effects = decide(scene, settings.effects, parts.in_effects)

        # S needs the body with a label per vertex.
        labelled: tuple[SkinnedBody | None, str] = (
            None,
            "the model leaves it out",
        )
        if parts.segmentation is not None:
            labelled = label_body(scene, images, vertex_labels)
        return _assemble(
            parts, encoder, scene, effects, labelled, settings.seed
        )


def _assemble(
    parts: AvatarParts,
    encoder: PoseGraph | PoseLinear | None,
    scene: SceneInfo,
    effects: Effects,
    labelled: tuple[SkinnedBody | None, str],
    seed: int,
) -> Avatar:
    """The avatar of parts that are sized to the scene.

    Each group of parts draws from its own seed, so that leaving one out does not change the start
    of the others. ``labelled``: S's body, and where its labels come from or why there is none.
    """
    template = template_of(scene.skeleton, scene.face)
    stature = template.stature_of(scene.limb_length_sum)
    antialias = effects.antialias.on

    # The points, and Ψ, which moves them; or Gaussians that move with the body alone.
    torch.manual_seed(seed + 1)
    body_points = _body_points(parts, scene, effects, stature)
    points = body_points or parts.densify
    deformation = surface = None
    if parts.deformation and points:
        light = None
        if effects.light.on:
            assert scene.proportions is not None
            light = scene.proportions.up
        placed = PlacedPoints(
            rest_points=points.rest_points,
            stature=stature,
            joints=len(template.names),
            sh_degree=effects.degree,
            cameras=scene.n_train_cameras,
            mean_step=1.0 if body_points is None else body_points.mean_step,
            scale_max=None if body_points is None else body_points.scale_max,
            light=light,
        )
        deformation = parts.deformation.build(placed)
    if parts.surface:
        body = _require_body(scene, "model.surface")
        surface = parts.surface.build(body, stature, effects.degree)

    # S forms its images like F.
    segmentation = None
    if parts.segmentation and labelled[0] is not None:
        segmentation = parts.segmentation.build(
            labelled[0],
            labelled=scene.has_labels,
            low_pass=parts.low_pass,
            antialias=antialias,
            backend=parts.backend,
        )

    # Parts on a body need its solver for skeletons without a body pose.
    solver = None
    if body_points or surface or segmentation:
        solver = Solver(_require_body(scene, "the model"))

    # The rest: the generator and the colour corrections.
    torch.manual_seed(seed + 2)
    splats = deformation or surface
    dense = False
    if body_points is not None:
        per_pixel = points_per_pixel(
            len(body_points.points), stature, scene.scale_train[1]
        )
        dense = per_pixel >= DENSE
    generator = None
    if parts.generator and encoder:
        # If nothing is splatted, the drawn skeleton takes F's place.
        drawn = len(template.draw_groups)
        channels = Channels(
            feature=3 + splats.features if splats else drawn,
            segmentation=segmentation.classes if segmentation else 0,
            skeleton=drawn if splats else 0,
            pose=encoder.channels,
            supersample=parts.supersample if splats else 1,
            dense=dense,
        )
        generator = parts.generator.build(channels)
    colour = None
    if effects.colour_correction.on:
        colour = ColourCorrection(effects.cameras, scene.camera_names)
    return Avatar(
        effects=effects,
        template=template,
        accuracy=replace(
            parts.accuracy,
            supersample=parts.supersample,
            low_pass=parts.low_pass,
            antialias=antialias,
        ),
        limb_length_sum=scene.limb_length_sum,
        stature=stature,
        deformation=deformation,
        densify=None if body_points else parts.densify,
        body_points=body_points,
        surface=surface,
        segmentation=segmentation,
        segmentation_why=labelled[1],
        pose_encoder=encoder,
        generator=generator,
        colour=colour,
        poses=scene.poses,
        solver=solver,
        **{name: getattr(parts, name) for name in OPTIONS},
    )


def _body_points(
    parts: AvatarParts, scene: SceneInfo, effects: Effects, stature: float
) -> BodyPoints | None:
    """Points on the skinned body; None where Gaussians start from the skeleton's shapes."""
    if not (parts.densify and parts.body_points and effects.body_points.on):
        return None
    body = _require_body(scene, "effects.body_points=on")
    return parts.body_points.build(body, stature, scene.scale_train[1])


@contextmanager
def naming_group(group: str) -> Iterator[None]:
    """Turns an error of a constructor into a ConfigError that names the config group."""
    try:
        yield
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"{group}: {str(error).partition(chr(10))[0]}"
        ) from error


def _require_body(scene: SceneInfo, part: str) -> MarkedBody:
    if not scene.has_body_pose:
        raise DataError(
            f"{part} cannot be built: the data lacks a body pose for every frame; choose "
            "model=splat_only or model=full"
        )

    # The body itself may be absent: model files of SMPL are the user's.
    body = open_body(
        scene.body, scene.body_file, scene.betas, scene.label_names
    )
    if body is None:
        raise DataError(
            f"{part} cannot be built: the data's poses are of the body {scene.body!r}, of which "
            "there is no model file; set data.smpl"
        )
    return body
