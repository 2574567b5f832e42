"""Run folders: the config, the checkpoint, and the avatar that they give."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import gsgan.model.assemble as assemble
from gsgan.body import open_body
from gsgan.body.skinned import MarkedBody
from gsgan.data.figure import Figure
from gsgan.effects import Effects
from gsgan.model.avatar import Avatar
from gsgan.skeleton import HOLISTIC
from gsgan.skeleton.tensors import constants
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.tensors import pick_device

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData
    from gsgan.data.scene_info import SceneInfo

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData, SceneInfo
    from gsgan.model.class_vote import Pictures

Float = NDArray[np.float64]
CHECKPOINT = Path("checkpoints") / "last.ckpt"
CONFIG = Path(".hydra") / "config.yaml"
# Keys that may differ between a run and its continuation: they do not change what it learns.
FREE_KEYS = (
    *("trainer", "logger", "resume", "evaluate", "grid_rows", "lpips", "cpu_hours", "viewer"),
    *("data.root", "data.smpl", "data.workers", "data.cache_mb", "data.val_pictures"),
    *("data.source.workers", "training.max_skipped", "training.skip_window", "model.backend"),
)
REMOVED_KEYS = (  # in the configs of older runs
    *("effects.measure", "data.reader.max_vertex_error", "data.reader.landmarks"),
)
RENAMED = {  # in the configs of older runs
    "gsgan.training.": "gsgan.train.",
    "gsgan.model.avatar.Avatar": "gsgan.model.assemble.assemble_avatar",
}


# -- config


@dataclass(frozen=True)
class Moved:
    """Where the dataset and the body model file of a run are now; None: where they were."""

    root: str | None = None
    smpl: str | None = None

    @classmethod
    def from_config(cls, config: DictConfig) -> Moved:
        """From ``data_root`` and ``data_smpl`` of a command's config."""
        return cls(config.data_root, config.data_smpl)

    def refuse_without_run(self) -> None:
        """Refuses the keys where no run is given, with a ConfigError."""
        if self != Moved():
            raise ConfigError("data_root and data_smpl are of a trained run; give run= too")


def read_config(folder: Path) -> DictConfig:
    """The config a run was started with, names of older versions replaced."""
    if not (folder / CONFIG).is_file():
        raise DataError(
            f"{folder}: not a run folder (no {CONFIG}); give the folder that gsgan.train printed"
        )
    try:
        config = OmegaConf.create(_with_new_names((folder / CONFIG).read_text()))
    except (UnicodeDecodeError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise DataError(f"{folder / CONFIG}: damaged ({str(error).splitlines()[0]})") from None
    if not isinstance(config, DictConfig) or not {"data", "model"} <= config.keys():
        raise DataError(f"{folder / CONFIG}: expected the config of a run with data and model")
    if OmegaConf.select(config, "effects.segmentation") is not None:  # until 2026-11-22
        raise DataError(
            f"{folder}: trained by an older gsgan, whose images had no alpha of their own; train "
            "again, or use the commit that its facts.json names"
        )
    for key in REMOVED_KEYS:
        group, _, last = key.rpartition(".")
        if (node := OmegaConf.select(config, group)) is not None:
            node.pop(last, None)
    return config


def _with_new_names(text: str) -> str:
    for old, new in RENAMED.items():
        text = text.replace(old, new)
    return text


def load_config(folder: Path, moved: Moved | None = None) -> DictConfig:
    """`read_config` with absolute paths of dataset and body model file, which must exist."""
    config, moved = read_config(folder), moved or Moved()
    if moved.smpl is not None and OmegaConf.select(config, "data.smpl") is None:
        # Skeletons from SMPL fits are others: the scores would be of another model.
        raise ConfigError(f"data_smpl: {folder} was trained without a body model file")
    for key, what in (("root", "dataset"), ("smpl", "body model file")):
        now = getattr(moved, key)
        stored = OmegaConf.select(config, f"data.{key}")
        place = from_start(folder, stored) if now is None else now
        if place is None:
            continue
        if not Path(place).expanduser().exists():
            raise DataError(
                f"{place} does not exist, the {what} of {folder}; give data_{key}=<where it is now>"
            )
        OmegaConf.update(config, f"data.{key}", place)
    return config


def from_start(folder: Path, place: str | None) -> str | None:
    """A path of a run's config; a relative one counts from where the run was started."""
    if place is None or Path(place).expanduser().is_absolute():
        return place
    started = OmegaConf.select(hydra_record(folder), "hydra.runtime.cwd")
    return place if started is None else str(Path(started) / place)


def hydra_record(folder: Path) -> DictConfig:
    """What Hydra recorded of a run's start; empty where that file is missing.

    Raises:
        DataError: when it is damaged.
    """
    path = folder / ".hydra" / "hydra.yaml"
    try:
        found = OmegaConf.load(path) if path.is_file() else OmegaConf.create()
    except (UnicodeDecodeError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise DataError(f"{path}: damaged ({str(error).splitlines()[0]})") from None
    assert isinstance(found, DictConfig)
    return found


def choices(folder: Path) -> dict[str, Any]:
    """The config groups' choices that Hydra recorded in a run folder; empty without a record."""
    found = OmegaConf.select(hydra_record(folder), "hydra.runtime.choices")
    return {} if found is None else {str(key): value for key, value in found.items()}


# -- building


def build_data(config: DictConfig) -> GsganData:
    """The data module of a config, its dataset made if need be, read and checked."""
    lens = str(assemble.effect_settings(config).requested("distortion"))
    data: GsganData = instantiate(config.data, distortion=lens)
    data.prepare_data()
    data.setup()
    return data


def build_avatar(config: DictConfig, data: GsganData, **stored: Any) -> Avatar:
    """The untrained avatar of a config and its data, see `gsgan.model.assemble.build_avatar`."""
    return assemble.build_avatar(config, data.info, data.labelled("train"), **stored)


# -- checkpoints


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint of gsgan, read without unrestricted pickle; a DataError when damaged."""
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file; the run has no checkpoint yet") from error
    except Exception as error:
        raise DataError(f"{path}: not a readable checkpoint; remove it to start over") from error
    if not isinstance(checkpoint, dict) or "gsgan" not in checkpoint:
        raise DataError(f"{path}: not a checkpoint of gsgan (it has no 'gsgan' entry)")
    return checkpoint


def scene_of(plain: Mapping[str, Any]) -> SceneInfo:
    """The properties of a scene that a checkpoint holds as plain values."""
    from gsgan.data.figure import Figure
    from gsgan.data.scene_info import SceneInfo
    from gsgan.data.surface_colours import SurfaceColours

    known = {f.name for f in fields(SceneInfo)}  # others were dropped since training
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in plain.items()
        if key in known
    }
    if (surface := values["surface"]) is not None:
        values["surface"] = SurfaceColours(surface["difference"], surface["residual"])
    if values.get("figure") is not None:
        values["figure"] = Figure(**values["figure"])
    return SceneInfo(**values)


def load(run: str | Path, *, smpl: str | Path | None = None, device: str = "auto") -> Avatar:
    """The trained, frozen avatar of a run folder, to `render`; the dataset is not needed.

    Args:
        run: the folder that ``gsgan.train`` printed.
        smpl: where the body model file is now, if the run read one and it has moved.
        device: ``auto``, ``cpu``, ``cuda`` or another torch device.

    Raises:
        GsganError: when the folder holds no run or no checkpoint, its checkpoint is damaged, or the
            model file is missing. Checkpoints older than this function need the dataset.
    """
    folder = Path(run).expanduser()
    config, checkpoint = read_config(folder), read_checkpoint(folder / CHECKPOINT)
    stored = checkpoint["gsgan"].get("scene")
    if stored is None:
        moved = Moved(smpl=None if smpl is None else str(smpl))
        data = build_data(load_config(folder, moved))
        avatar = _trained(folder, config, checkpoint, data.info, data.labelled("train"))
    else:
        avatar = avatar_of(folder, config, checkpoint, smpl)
    return avatar.to(pick_device(device))


def avatar_of(
    folder: Path, config: DictConfig, checkpoint: dict[str, Any], smpl: str | Path | None = None
) -> Avatar:
    """The trained, frozen avatar of a checkpoint that holds the facts about its scene.

    Args:
        folder: the run's, for messages.
        config: of the run.
        checkpoint: its weights and facts.
        smpl: as for `load`.
    """
    scene = scene_of(checkpoint["gsgan"]["scene"])
    file = from_start(folder, scene.body_file) if smpl is None else str(smpl)
    return _trained(folder, config, checkpoint, replace(scene, body_file=file))


def load_avatar(folder: Path, config: DictConfig, data: GsganData) -> tuple[Avatar, list[str]]:
    """The trained, frozen avatar of a run folder, and the marks its tables must carry."""
    checkpoint = read_checkpoint(folder / CHECKPOINT)
    avatar = _trained(folder, config, checkpoint, data.info, data.labelled("train"))
    return avatar, list(checkpoint["gsgan"]["marks"])


def _trained(
    folder: Path,
    config: DictConfig,
    checkpoint: dict[str, Any],
    scene: SceneInfo,
    pictures: Pictures | None = None,
) -> Avatar:
    prefix = "average.copy.module." if checkpoint["gsgan"].get("averaged") else "avatar."
    state = {
        key.removeprefix(prefix): value
        for key, value in checkpoint["state_dict"].items()
        if key.startswith(prefix)
    }
    decided = checkpoint["gsgan"].get("effects")
    segments = "segmentation.quats" in state
    avatar = assemble.build_avatar(
        config,
        scene,
        pictures,
        vertex_labels=state.get("segmentation.vertex_labels"),
        effects=None if decided is None else Effects.from_plain(decided),
        labelled="segmentation.common" not in state if segments else None,
    )
    if segments and avatar.segmentation is None:
        raise DataError(
            f"{folder}: trained with S, which cannot be built now: {avatar.segmentation_why}; set "
            f"data.smpl in {folder / CONFIG} to the model file"
        )
    try:
        avatar.load_state_dict(state)
    except RuntimeError as error:
        raise DataError(
            f"{folder / CHECKPOINT}: its weights do not fit the config {folder / CONFIG}"
        ) from error
    return avatar.freeze()


# -- settings


def record(config: DictConfig) -> dict[str, Any]:
    """The config as plain values, without the keys that a continuation may change."""
    plain = {
        str(key): OmegaConf.to_container(value, resolve=True)
        if OmegaConf.is_config(value := config[key])
        else value
        for key in config
        if key not in FREE_KEYS
    }
    return as_resumed(plain)


def as_resumed(plain: dict[str, Any]) -> dict[str, Any]:
    """The values that must not change when a run is resumed, under their present names."""
    plain = json.loads(_with_new_names(json.dumps(plain)))
    for key in (*FREE_KEYS, *REMOVED_KEYS):
        *groups, last = key.split(".")
        node: Any = plain
        for group in groups:
            node = node.get(group) if isinstance(node, dict) else None
        if isinstance(node, dict):
            node.pop(last, None)
    return plain


@dataclass
class Run:
    """A run folder; its dataset is opened only where it is needed.

    Args:
        folder: of the run.
        stored: its config.
        checkpoint: ``gsgan`` of its checkpoint; empty where training has not written one yet.
        avatar: frozen.
        moved: where its dataset and body model file are now.
        opened: its dataset, or None.
    """

    folder: Path
    stored: DictConfig
    checkpoint: dict[str, Any]
    avatar: Avatar
    moved: Moved = field(default_factory=Moved)
    opened: GsganData | None = None

    @classmethod
    def load(cls, config: DictConfig) -> Run:
        """The run of ``config.run``.

        Raises:
            ConfigError: when it is not set.
            DataError: when the folder holds no run, or a damaged one.
        """
        if config.run is None:
            raise ConfigError("run is not set: give run=<the folder that gsgan.train printed>")
        folder, moved = Path(config.run).expanduser(), Moved.from_config(config)
        stored, facts = read_config(folder), read_checkpoint(folder / CHECKPOINT)["gsgan"]
        return cls(
            folder, stored, facts, load(folder, smpl=moved.smpl, device=config.device), moved
        )

    @property
    def data(self) -> GsganData:
        """The run's dataset."""
        if self.opened is None:
            self.opened = build_data(load_config(self.folder, self.moved))
        return self.opened

    @property
    def scene(self) -> SceneInfo:
        """Facts about the scene; older checkpoints lack some, and need the dataset."""
        stored = self.checkpoint.get("scene")
        if self.opened is None and stored is not None and stored.get("figure") is not None:
            return scene_of(stored)
        return self.data.info

    @property
    def body(self) -> MarkedBody | None:
        """The skinned body that the avatar moves with, in the subject's shape, or None."""
        if not self.avatar.needs_body:
            return None
        return open_body(self.scene.body, self.body_file, self.scene.betas)

    @property
    def body_file(self) -> str | None:
        """The user's model file of the body, or None."""
        return self.moved.smpl or from_start(self.folder, self.scene.body_file)

    @property
    def figure(self) -> Figure:
        """The subject's proportions."""
        assert self.scene.figure is not None
        return self.scene.figure

    @property
    def face(self) -> Float:
        """``[30, 3]`` metres: the subject's face at rest, see `gsgan.skeleton.in_head`; the
        template's for avatars without a face."""
        template = self.avatar.template
        template = template if template.expression else HOLISTIC
        return constants(template, torch.device("cpu"), torch.float64).face_rest.numpy()
