"""Builds the data module and the avatar of a config."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor, nn
from torch.utils.data import Subset

from gsgan.body import SkinnedBody, open_body
from gsgan.body.skinned import MarkedBody
from gsgan.body.solve import Solver
from gsgan.data.scene_info import SceneInfo
from gsgan.effects import Effects, EffectSettings, ModelParts, decide
from gsgan.effects.record import OFF
from gsgan.model.avatar import Avatar
from gsgan.model.body_points import (
    AUTO,
    DENSE,
    BodyPoints,
    points_per_pixel,
)
from gsgan.model.colour import ColourCorrection
from gsgan.model.deformation import Deformation
from gsgan.model.generator import Generator
from gsgan.model.residual_gaussians import ResidualGaussians
from gsgan.model.segmentation import Segmentation
from gsgan.model.surface import SurfaceGaussians
from gsgan.run.class_vote import label_body
from gsgan.scene import Frame
from gsgan.skeleton import Densify, SkeletonTemplate, template_of
from gsgan.splat import BACKENDS, Accuracy
from gsgan.utils.checks import one_of
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


def build_data(config: DictConfig) -> GsganData:
    """The data module of a config, its dataset made if need be, read and checked."""
    # Images are undistorted when they are read, so the dataset knows that effect.
    distortion = _effect_settings(config).value_of("distortion")
    data: GsganData = instantiate(config.data, distortion=distortion)
    data.prepare_data()
    data.setup()
    return data


def moves_with_body(config: DictConfig) -> bool:
    """Whether a config's model has parts that move with a skinned body, if the data has one."""
    # S and Gaussians on the body always need it; placing G there is an effect.
    model = config.model
    if (
        model.get("segmentation") is not None
        or model.get("surface") is not None
    ):
        return True
    on_body = _effect_settings(config).value_of("body_points") != OFF
    return model.get("body_points") is not None and on_body


def build_avatar(
    config: DictConfig,
    scene: SceneInfo,
    images: Subset[Frame] | None = None,
    *,
    effects: Effects | None = None,
    vertex_labels: Tensor | None = None,
) -> Avatar:
    """The untrained avatar of a config, its weights from ``config.seed``.

    Args:
        config: of a run.
        scene: facts about the training split.
        images: training frames with part labels, for the class vote.
        effects: decided when training began; None decides them now.
        vertex_labels: ``[V]`` int64, the result of an earlier vote, which is then not repeated.

    Raises:
        ConfigError: on a forced effect that is not possible, on parts that do not go together, or
            on a key that is not read.
        DataError: when the data lacks the body that the model needs.
    """
    # The experiment sets keys of `densify` in models that have no such part.
    densify = config.model.get("densify")
    if densify is not None and "_target_" not in densify:
        raise ConfigError(
            "experiment=paper changes parts that this model does not have; it goes with "
            "model=full, wo_feat, wo_seg, wo_gcn or splat_only"
        )

    # Parts draw their weights when they are made, so the seed comes first.
    torch.manual_seed(config.seed)
    with naming_group("model"):
        parts: AvatarParts = instantiate(config.model)()
        settings = _effect_settings(config)
        effects = effects or decide(scene, settings, parts.in_effects)

        # S needs the body with a label per vertex.
        labelled: tuple[SkinnedBody | None, str] = (
            None,
            "the model leaves it out",
        )
        if parts.segmentation is not None:
            labelled = label_body(scene, images, vertex_labels)
        return _assemble(parts, scene, effects, labelled, config.seed)


@dataclass(frozen=True)
class AvatarParts:
    """The config group ``model`` (keys: conf/model/full.yaml).

    Parts whose sizes depend on the scene are functions of those sizes (``_partial_`` in the
    config).

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
        ValueError: on parts that do not go together.
    """

    # Every model names these, if only as null.
    accuracy: Accuracy
    densify: Densify | None
    deformation: Callable[..., ResidualGaussians] | None
    segmentation: Callable[..., Segmentation] | None
    pose_encoder: nn.Module | None
    generator: Callable[..., Generator] | None

    # Some models have these, too.
    surface: Callable[..., SurfaceGaussians] | None = None
    body_points: partial[BodyPoints] | None = None
    low_pass: float = 0.3
    supersample: int = 1
    backend: str = "auto"
    window_margin: float | None = 0.25
    window_multiple: int = 16
    window_minimum: int = 32
    generator_margin: int | None = 8

    def __post_init__(self) -> None:
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
            network=issubclass(
                getattr(self.deformation, "func", object), Deformation
            ),
            body_points=self.body_points is not None,
        )


def _assemble(
    parts: AvatarParts,
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
    sizes = {"stature": stature, "sh_degree": effects.degree}
    formation: dict[str, Any] = {
        "low_pass": parts.low_pass,
        "antialias": effects.antialias.on,
    }

    # The points, and Ψ, which moves them; or Gaussians that move with the body alone.
    torch.manual_seed(seed + 1)
    body_points = _body_points(parts, scene, effects, stature)
    points = body_points or parts.densify
    deformation = surface = None
    if parts.deformation and points:
        deformation = parts.deformation(
            rest_points=points.rest_points,
            joints=len(template.names),
            **sizes,
            **_set_by_scene(parts, scene, effects, body_points),
        )
    if parts.surface:
        body = _require_body(scene, "model.surface")
        surface = parts.surface(body=body, **sizes)

    # S forms its images like F.
    segmentation = None
    if parts.segmentation and labelled[0] is not None:
        segmentation = parts.segmentation(
            body=labelled[0], labelled=scene.has_labels
        )
        segmentation.accuracy = replace(segmentation.accuracy, **formation)
        segmentation.backend = parts.backend

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
    generator = _generator(parts, template, splats, segmentation, dense=dense)
    colour = None
    if effects.colour_correction.on:
        colour = ColourCorrection(effects.cameras, scene.camera_names)
    return Avatar(
        effects=effects,
        template=template,
        accuracy=replace(
            parts.accuracy, supersample=parts.supersample, **formation
        ),
        limb_length_sum=scene.limb_length_sum,
        stature=stature,
        deformation=deformation,
        densify=None if body_points else parts.densify,
        body_points=body_points,
        surface=surface,
        segmentation=segmentation,
        segmentation_why=labelled[1],
        pose_encoder=parts.pose_encoder,
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
    return parts.body_points(
        body=_require_body(scene, "effects.body_points=on"),
        stature=stature,
        scale=scene.scale_train[1],
    )


def _set_by_scene(
    parts: AvatarParts,
    scene: SceneInfo,
    effects: Effects,
    body_points: BodyPoints | None,
) -> dict[str, Any]:
    """Arguments of Ψ that the scene or the points decide."""
    settings: dict[str, Any] = {}
    if body_points is not None:
        settings["mean_step"] = body_points.mean_step
        if body_points.scale_max is not None:
            settings["scale_max"] = body_points.scale_max

    # A config with normals=null leaves it to the number of cameras.
    given = getattr(parts.deformation, "keywords", {})
    if given.get("normals", False) is None:
        settings["normals"] = scene.n_train_cameras > 1
    if effects.light.on:
        assert scene.proportions is not None
        settings["light"] = scene.proportions.up
    return settings


def _generator(
    parts: AvatarParts,
    template: SkeletonTemplate,
    splats: ResidualGaussians | SurfaceGaussians | None,
    segmentation: Segmentation | None,
    *,
    dense: bool,
) -> Generator | None:
    """The UNet; if nothing is splatted, the drawn skeleton takes F's place.

    ``dense``: Gaussians on the body are as many as pixels, which a last level would not sharpen.
    """
    if parts.generator is None or parts.pose_encoder is None:
        return None

    # A generator of one's own need not have the setting.
    options: dict[str, Any] = {}
    if getattr(parts.generator, "keywords", {}).get("refine") == AUTO:
        options["refine"] = not dense

    # Channels of its inputs; F has three for the colour of Step I before its features.
    drawn = len(template.draw_groups)
    return parts.generator(
        feature_channels=3 + splats.features if splats else drawn,
        segmentation_channels=segmentation.classes if segmentation else 0,
        skeleton_channels=drawn if splats else 0,
        pose_channels=parts.pose_encoder.channels,
        supersample=parts.supersample if splats else 1,
        **options,
    )


def _effect_settings(config: DictConfig) -> EffectSettings:
    """The effects group of a config; commands that score other methods have none."""
    return (
        instantiate(config.effects) if "effects" in config else EffectSettings()
    )


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
