"""The files of a run folder: its config and its checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from gsgan.data.scene_info import SceneInfo
from gsgan.data.surface_colours import SurfaceColours
from gsgan.skeleton.proportions import Proportions
from gsgan.skeleton.training_poses import TrainingPoses
from gsgan.utils.errors import ConfigError, DataError

CHECKPOINT = Path("checkpoints") / "last.ckpt"
# Keys that configs of runs before 2026-11-29 have, and that nothing reads now.
UNREAD_KEYS = ("effects.generator", "effects.gaussians_per_pixel")
# What such configs build, and is now built by settings of the same name.
PARTS = "gsgan.run.assemble.AvatarParts"
OLD_TARGETS = (
    "gsgan.model.body_points.BodyPoints",
    "gsgan.model.deformation.Deformation",
    "gsgan.model.discriminator.Discriminator",
    "gsgan.model.generator.Generator",
    "gsgan.model.harmonic.Harmonic",
    "gsgan.model.pose_graph.PoseGraph",
    "gsgan.model.pose_graph.PoseLinear",
    "gsgan.model.segmentation.Segmentation",
    "gsgan.model.surface.SurfaceGaussians",
    "gsgan.losses.perceptual.Perceptual",
    "gsgan.train.module.AvatarTraining",
)
CONFIG = Path(".hydra") / "config.yaml"
# Keys that may differ between a run and its continuation: they do not change what it learns.
FREE_KEYS = (
    # The machine, and how long the run goes on.
    "trainer",
    "logger",
    "callbacks",
    "resume",
    # What is scored and shown at the end.
    "evaluate",
    "grid_rows",
    "score_images",
    "lpips",
    "cpu_hours",
    "objective",
    "page",
    # Where the data is, and how it is loaded.
    "data.root",
    "data.smpl",
    "data.workers",
    "data.cache_mb",
    "data.val_images",
    "data.source.workers",
    # When a diverged training gives up.
    "training.max_skipped",
    "training.skip_window",
    # Backends compute the same image; the generator's box is not used in training.
    "model.backend",
    "model.generator_margin",
)


# -- config


@dataclass(frozen=True)
class DataPaths:
    """Paths of a run's dataset and body model file; None if they have not moved."""

    root: str | None = None
    smpl: str | None = None

    def refuse_without_run(self) -> None:
        """Raises a ConfigError if a path is given without a run."""
        if self != DataPaths():
            raise ConfigError("data_root and data_smpl require run=")


def read_config(folder: Path) -> DictConfig:
    """The config that a run was started with.

    Raises:
        DataError: when the folder holds no run, or its config is damaged.
    """
    # The config lies where Hydra wrote it when the run was started.
    path = folder / CONFIG
    if not path.is_file():
        raise DataError(
            f"{folder}: not a run folder (no {CONFIG}); give the folder that gsgan.train printed"
        )
    config = read_yaml(path)
    if not {"data", "model"} <= config.keys():
        raise DataError(
            f"{path}: expected the config of a run with data and model"
        )
    return config


def read_yaml(path: Path) -> DictConfig:
    """A file of Hydra's in a run folder, without the keys that nothing reads now.

    Raises:
        DataError: when it is damaged.
    """
    try:
        config = OmegaConf.create(path.read_text(encoding="utf-8"))
    except (
        UnicodeDecodeError,
        yaml.YAMLError,
        OmegaConfBaseException,
    ) as error:
        raise DataError(
            f"{path}: damaged ({str(error).splitlines()[0]})"
        ) from None
    if not isinstance(config, DictConfig):
        raise DataError(f"{path}: damaged (expected keys with values)")
    renew(config)
    return config


def renew(settings: MutableMapping[str, Any]) -> None:
    """Gives the config of an older run, or its `record`, the present names, in place."""
    for key in UNREAD_KEYS:
        group, last = _group(settings, key)
        group.pop(last, None)

    # A module `gsgan.model.….Generator` is built by its settings.
    for name in ("model", "training"):
        parts = settings.get(name)
        if not isinstance(parts, MutableMapping):
            continue
        for node in (parts, *parts.values()):
            if not isinstance(node, MutableMapping):
                continue
            target = node.get("_target_")
            if target in OLD_TARGETS:
                node["_target_"] = f"{target}Settings"
            if target in (*OLD_TARGETS, PARTS):
                node.pop("_partial_", None)


def _group(
    settings: MutableMapping[str, Any], key: str
) -> tuple[MutableMapping[str, Any], str]:
    """The group that a dotted key belongs to, empty where there is none, and its last part."""
    *groups, last = key.split(".")
    for group in groups:
        group_settings = settings.get(group)
        settings = (
            group_settings if isinstance(group_settings, MutableMapping) else {}
        )
    return settings, last


def load_config(folder: Path, paths: DataPaths | None = None) -> DictConfig:
    """`read_config` with absolute paths of dataset and body model file, which must exist."""
    config = read_config(folder)
    paths = paths or DataPaths()

    # Only a run that read a model file can read another copy of it.
    if paths.smpl is not None and OmegaConf.select(config, "data.smpl") is None:
        # Skeletons would then be those of SMPL fits, and the scores of another model.
        raise ConfigError(
            f"data_smpl: {folder} was trained without a body model file"
        )

    # Paths of the run, unless the user gives others.
    for key, what in (("root", "dataset"), ("smpl", "body model file")):
        now = getattr(paths, key)
        stored = OmegaConf.select(config, f"data.{key}")
        place = absolute_path(folder, stored) if now is None else now
        if place is None:  # the run reads no such file
            continue
        if not Path(place).expanduser().exists():
            raise DataError(
                f"{place} does not exist, the {what} of {folder}; give data_{key}=<where it is now>"
            )
        OmegaConf.update(config, f"data.{key}", place)
    return config


def other_capture(folder: Path, given: str | Mapping[str, Any]) -> DictConfig:
    """A run's config with the data of another capture: its folder, or the keys that differ.

    Body poses are left out, as they are of another body, and so are the run's splits.

    Raises:
        ConfigError: on a key that the run's data lacks.
    """
    config = read_config(folder)

    # The run's own data, splits and protocol do not hold for another capture.
    cameras = ("train_cameras", "test_cameras")
    splits = (*cameras, "train_frames", "test_frames", "train_poses")
    cleared = dict.fromkeys(("root", "protocol", *splits)) | {"body": "none"}
    config.data.merge_with(cleared)

    # Only keys that the data has can be changed.
    OmegaConf.set_struct(config, True)
    try:
        config.data.merge_with(
            {"root": given} if isinstance(given, str) else given
        )
    except ConfigKeyError as error:
        raise ConfigError(
            f"other_capture: {str(error).splitlines()[0]} of the run's data"
        ) from None
    return config


class Chosen(NamedTuple):
    """What may have watched a run's validation images.

    Args:
        callbacks: settings by name.
        objective: of a search, or None.
    """

    callbacks: Mapping[str, Mapping[str, Any]]
    objective: str | None

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Chosen:
        """The settings of a run's config."""
        return cls(config.get("callbacks") or {}, config.get("objective"))


def absolute_path(folder: Path, path: str | None) -> str | None:
    """A path of a run's config; a relative one counts from where the run was started."""
    if path is None or Path(path).expanduser().is_absolute():
        return path

    # Hydra has recorded the folder in which the command was started.
    start = OmegaConf.select(hydra_record(folder), "hydra.runtime.cwd")
    return path if start is None else str(Path(start) / path)


def hydra_record(folder: Path) -> DictConfig:
    """Hydra's record of a run's start; empty where that file is missing.

    Raises:
        DataError: when it is damaged.
    """
    path = folder / ".hydra" / "hydra.yaml"
    return read_yaml(path) if path.is_file() else OmegaConf.create()


def choices(folder: Path) -> dict[str, Any]:
    """The config groups' choices that Hydra recorded in a run folder; empty without a record."""
    recorded = OmegaConf.select(hydra_record(folder), "hydra.runtime.choices")
    return (
        {}
        if recorded is None
        else {str(key): value for key, value in recorded.items()}
    )


def record(config: DictConfig) -> dict[str, Any]:
    """The config as plain values, without the keys that a continuation may change."""
    # Free groups are left out before anything is resolved.
    plain: dict[str, Any] = {}
    for key in config:
        if key not in FREE_KEYS:
            value = config[key]
            if OmegaConf.is_config(value):
                value = OmegaConf.to_container(value, resolve=True)
            plain[str(key)] = value

    # Single keys of groups are removed by their dotted names.
    for key in FREE_KEYS:
        group, last = _group(plain, key)
        group.pop(last, None)
    return plain


# -- checkpoint


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint of gsgan, read without unrestricted pickle; a DataError when damaged."""
    # Tensors and plain values only: a checkpoint from somebody else cannot run code.
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise DataError(
            f"{path}: no such file; the run has no checkpoint yet"
        ) from error
    except Exception as error:
        raise DataError(
            f"{path}: not a readable checkpoint; remove it to start over"
        ) from error

    # Other programs' checkpoints lack these entries.
    if not (
        isinstance(checkpoint, dict)
        and {"gsgan", "state_dict"} <= checkpoint.keys()
    ):
        raise DataError(
            f"{path}: not a checkpoint of gsgan (no entries 'gsgan' and 'state_dict')"
        )
    return checkpoint


def read_scene(plain: Mapping[str, Any]) -> SceneInfo:
    """The facts about a scene that a checkpoint holds as plain values."""
    # Checkpoints hold lists for tuples, and dicts for dataclasses.
    values: dict[str, Any] = {}
    for key, value in plain.items():
        values[key] = tuple(value) if isinstance(value, list) else value
    for key, kind in (
        ("surface", SurfaceColours),
        ("proportions", Proportions),
        ("poses", TrainingPoses),
    ):
        if values.get(key) is not None:
            values[key] = kind(**values[key])

    # Called by another name until 2026-11-29.
    if "body_height" in values:
        values["limb_length_sum"] = values.pop("body_height")
    return SceneInfo(**values)
