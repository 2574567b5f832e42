"""Builds an avatar: the parts of a config, sized to a scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor, nn

from gsgan.body import open_body
from gsgan.body.skinned import MarkedBody
from gsgan.body.solve import Solver
from gsgan.effects import Effects, EffectSettings, ModelParts, decide
from gsgan.model.avatar import Avatar
from gsgan.model.body_points import BodyPoints
from gsgan.model.class_vote import ClassVote, Pictures, labelled_body
from gsgan.model.deformation import Deformation
from gsgan.model.generator import Generator
from gsgan.model.painting import ColourCorrection
from gsgan.model.segmentation import Segmentation
from gsgan.model.surface import SurfaceGaussians
from gsgan.skeleton import Densify, template_of
from gsgan.splat import BACKENDS, Accuracy
from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError, DataError

if TYPE_CHECKING:
    from gsgan.data.scene_info import SceneInfo  # loads the data package


def build_avatar(
    config: DictConfig,
    scene: SceneInfo,
    pictures: Pictures | None = None,
    *,
    vertex_labels: Tensor | None = None,
    effects: Effects | None = None,
    labelled: bool | None = None,
) -> Avatar:
    """The untrained avatar of a config, its weights from ``config.seed``; see `assemble_avatar`."""
    if config.model.get("densify") is not None and "_target_" not in config.model.densify:
        raise ConfigError(
            "experiment=paper changes parts that this model does not have; it goes with "
            "model=full, wo_feat, wo_seg, wo_gcn or splat_only"
        )
    torch.manual_seed(config.seed)
    with naming_group("model"):
        avatar: Avatar = instantiate(config.model)(
            scene=scene,
            pictures=pictures,
            vertex_labels=vertex_labels,
            labelled=labelled,
            effects=effects,
            settings=effect_settings(config),
        )
    return avatar


def assemble_avatar(
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
    class_vote: ClassVote | None = None,
    pictures: Pictures | None = None,
    vertex_labels: Tensor | None = None,
    labelled: bool | None = None,
    effects: Effects | None = None,
    settings: EffectSettings | None = None,
    **options: Any,
) -> Avatar:
    """Builds each part with its sizes and puts them together (keys: conf/model/full.yaml).

    Convention: parts whose sizes depend on the scene arrive as functions of those sizes
    (``_partial_`` in the config). Each group of parts draws from its own seed, so leaving one out
    does not change the start of the others.

    Args:
        scene: facts about the training split.
        densify, deformation: skeleton to points; Ψ, given rest points, height, joints, SH degree.
        segmentation: S, given a body; None leaves it out (``wo_seg``).
        pose_encoder, generator: Ω (or the flat skeleton) to g; the UNet, given its channel counts.
            Without them Step I's colour is the image.
        accuracy: the rasteriser's settings for F.
        surface: in place of Ψ, any Gaussians that move with the body (``lbs_splat``), given the
            body, its height and the SH degree. Without either nothing is splatted and the UNet
            paints the drawn skeleton alone (``image_to_image``).
        body_points: in place of densify where that effect is on, given the body and its height.
        low_pass, supersample, backend: of F, and of S where it has them.
        class_vote: gives S's vertices their parts where the data's labels are not the body's own.
        pictures: training frames with labels, for that vote.
        vertex_labels: ``[V]`` int64, the result of an earlier vote, which is then not repeated.
        labelled: whether S was trained on part labels; None: whether the data has some.
        effects: decided when training began; None decides them here, by ``settings``.
        options: of `Avatar`: window_margin, window_multiple, window_least.

    Raises:
        ConfigError: on a forced effect that is not possible, or a key that is not read.
        DataError: when the data lacks the body that the model needs.
        ValueError: on parts that do not go together.
    """
    one_of("model.backend", backend, BACKENDS)
    template = template_of(scene.skeleton, scene.face)
    for wrong, message in (
        ((deformation is None) != (densify is None), "densify and deformation go together"),
        ((generator is None) != (pose_encoder is None), "generator and pose_encoder go together"),
        (deformation and surface, "give a deformation or a surface, got both"),
        (
            not (deformation or surface or generator),
            "nothing paints; give a deformation, a surface or a generator",
        ),
    ):
        if wrong:
            raise ValueError(message)
    if effects is None:
        model = ModelParts(
            splats=densify is not None or surface is not None,
            points=densify is not None,
            body_points=body_points is not None,
        )
        effects = decide(scene, settings or EffectSettings(), model)
    formation: dict[str, Any] = {"low_pass": low_pass, "antialias": effects.antialias.on}
    # Stature, from limb lengths: the skeleton measures it and no pose changes it.
    body_height = float(scene.body_height) * template.stature / template.limb_length_sum
    sizes = {"body_height": body_height, "sh_degree": effects.degree}

    seed = torch.initial_seed()
    torch.manual_seed(seed + 1)
    on_body = None
    if densify is not None and body_points is not None and effects.body_points.on:
        held = _body_of(scene, "effects.body_points=on")
        on_body = body_points(body=held, body_height=body_height)
    psi = None
    if densify is not None and deformation is not None:
        rest, joints = (on_body or densify).rest_points, len(template.names)
        psi = deformation(rest_points=rest, joints=joints, **sizes)
    skin = None if surface is None else surface(body=_body_of(scene, "model.surface"), **sizes)
    splats: Deformation | SurfaceGaussians | None = psi or skin
    S, why = None, "the model leaves it out"
    if segmentation is not None:
        body, why = labelled_body(scene, class_vote or ClassVote(), pictures, vertex_labels)
        if body is not None:
            S = segmentation(body=body, labelled=scene.has_labels if labelled is None else labelled)
            S.accuracy, S.backend = replace(S.accuracy, **formation), backend

    on_a_body = on_body is not None or skin is not None or S is not None
    solver = Solver(_body_of(scene, "the model")) if on_a_body else None

    torch.manual_seed(seed + 2)
    unet, drawn = None, len(template.draw_groups)
    if generator is not None and pose_encoder is not None:
        unet = generator(
            feature_channels=drawn if splats is None else 3 + splats.features,
            segmentation_channels=S.classes if S else 0,
            skeleton_channels=drawn if splats else 0,
            pose_channels=pose_encoder.channels,
            supersample=supersample if splats else 1,
        )
    colour = None
    if effects.colour_correction.on:
        colour = ColourCorrection(effects.cameras, scene.camera_names)
    return Avatar(
        effects=effects,
        template=template,
        accuracy=replace(accuracy, supersample=supersample, **formation),
        limb_length_sum=float(scene.body_height),
        body_height=body_height,
        deformation=psi,
        densify=None if on_body else densify,
        body_points=on_body,
        surface=skin,
        segmentation=S,
        segmentation_why=why,
        pose_encoder=pose_encoder,
        generator=unet,
        colour=colour,
        solver=solver,
        backend=backend,
        **options,
    )


def effect_settings(config: DictConfig) -> EffectSettings:
    """The effects group of a config; the defaults for runs older than that group."""
    if config.get("effects") is None:
        return EffectSettings()
    settings: EffectSettings = instantiate(config.effects)
    return settings


@contextmanager
def naming_group(group: str) -> Iterator[None]:
    """Turns an error of a constructor into a ConfigError that names the config group."""
    try:
        yield
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(f"{group}: {error}") from error


def _body_of(scene: SceneInfo, part: str) -> MarkedBody:
    if not scene.has_body_pose:
        raise DataError(
            f"{part} cannot be built: the data lacks a body pose for every frame; choose "
            "model=splat_only or model=full"
        )
    body = open_body(scene.body, scene.body_file, scene.betas, scene.label_names)
    if body is None:
        raise DataError(
            f"{part} cannot be built: the data's poses are of the body {scene.body!r}, of which "
            "there is no model file; set data.smpl"
        )
    return body
