"""A run folder: its config, its checkpoint, and the avatar that comes out of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsgan.effects import Effects, EffectSettings, decide
from gsgan.model.avatar import Avatar
from gsgan.utils.errors import ConfigError, DataError

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData
    from gsgan.train.module import AvatarTraining

DISCRIMINATOR_SALT = 1000
CHECKPOINT = Path("checkpoints") / "last.ckpt"
# What may differ between a run and its continuation: where and how it runs, not what it learns.
FREE_KEYS = (
    *("trainer", "logger", "resume", "evaluate", "grid_rows", "lpips", "cpu_hours"),
    *("data.root", "data.smpl", "data.workers", "data.cache_mb", "data.val_pictures"),
    *("data.source.workers", "training.max_skipped", "training.skip_window", "model.backend"),
)


def record(config: DictConfig) -> dict[str, Any]:
    """The config as plain values, without the keys a continuation may change."""
    plain: dict[str, Any] = {
        str(key): OmegaConf.to_container(value, resolve=True)
        if OmegaConf.is_config(value := config[key])
        else value
        for key in config
        if key not in FREE_KEYS
    }
    for key in FREE_KEYS:
        *groups, last = key.split(".")
        node: Any = plain
        for group in groups:
            node = node.get(group) if isinstance(node, dict) else None
        if isinstance(node, dict):
            node.pop(last, None)
    return plain


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint of gsgan, read without unrestricted pickle.

    Raises:
        DataError: when the file is damaged or is no checkpoint of gsgan.
    """
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file; the run has no checkpoint yet") from error
    except Exception as error:
        raise DataError(
            f"{path}: not a readable checkpoint ({type(error).__name__}); it may be cut off: "
            "remove it to start over"
        ) from error
    if not isinstance(checkpoint, dict) or "gsgan" not in checkpoint:
        raise DataError(f"{path}: not a checkpoint of gsgan (it has no 'gsgan' entry)")
    return checkpoint


def checkpoint_to_resume(folder: Path, now: Mapping[str, Any], marks: list[str]) -> Path | None:
    """The checkpoint of an earlier part of this very run, or None.

    Args:
        folder: the run's.
        now: what the run's checkpoints will hold, of `training_record`.
        marks: the run's stand-ins.

    Raises:
        ConfigError: when the folder holds a run with other settings.
        DataError: when its checkpoint cannot be read.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    state = read_checkpoint(path)["gsgan"]
    if state["marks"] != marks:
        raise ConfigError(
            f"{folder} holds a run whose stand-ins were other ones "
            f"({'; '.join(state['marks']) or 'none'}; now {'; '.join(marks) or 'none'}); set "
            "training.perceptual.weights as it was, or resume=false to start over there"
        )
    changed = sorted(set(_differences(state["record"], now)))
    if changed:
        shown = ", ".join(changed[:5]) + (" …" if len(changed) > 5 else "")
        raise ConfigError(
            f"{folder} holds a run with other settings ({shown}); choose another hydra.run.dir, "
            "or resume=false to start over there"
        )
    return path


def _differences(before: Any, now: Any, at: str = "") -> list[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        keys = sorted(set(before) | set(now), key=str)
        found = []
        for key in keys:
            found += _differences(before.get(key), now.get(key), f"{at}.{key}" if at else str(key))
        return found
    return [] if before == now else [at]


@dataclass(frozen=True)
class Moved:
    """Where a run's dataset and body model file lie now; None: where they lay."""

    root: str | None = None
    smpl: str | None = None

    @classmethod
    def said(cls, config: DictConfig) -> Moved:
        """As ``data_root`` and ``data_smpl`` of a command's config say it."""
        return cls(config.data_root, config.data_smpl)

    def refuse_without_run(self) -> None:
        """What a command calls that was given no run: nothing can have moved.

        Raises:
            ConfigError: when something is said to have moved.
        """
        if self != Moved():
            raise ConfigError("data_root and data_smpl are of a trained run; give run= too")


def load_config(folder: Path, moved: Moved | None = None) -> DictConfig:
    """The config a run was started with, its paths absolute, or where they have moved.

    Raises:
        ConfigError: when a model file is given for a run that read none.
        DataError: when the folder is not a run folder, or its data is no longer there.
    """
    path = folder / ".hydra" / "config.yaml"
    if not path.is_file():
        raise DataError(
            f"{folder}: not a run folder (no .hydra/config.yaml); give run=<the folder that "
            "gsgan.train printed>"
        )
    config = OmegaConf.create(path.read_text().replace("gsgan.training.", "gsgan.train."))
    assert isinstance(config, DictConfig)
    if OmegaConf.select(config, "effects.segmentation") is not None:  # until 2026-11-22
        raise DataError(
            f"{folder}: trained by an older gsgan, whose pictures had no alpha of their own; train "
            "again, or use the commit that its facts.json names"
        )
    moved = moved or Moved()
    if moved.smpl is not None and OmegaConf.select(config, "data.smpl") is None:
        # A skeleton from fits is another one: the scores would be of another model.
        raise ConfigError(f"data_smpl: {folder} was trained without a body model file")
    for key, what, now in (
        ("root", "dataset", moved.root),
        ("smpl", "body model file", moved.smpl),
    ):
        stored = OmegaConf.select(config, f"data.{key}")
        place = stored if now is None else now
        if place is None:
            continue
        if now is None and not Path(place).expanduser().is_absolute():
            started = OmegaConf.load(folder / ".hydra" / "hydra.yaml").hydra.runtime.cwd
            place = str(Path(started) / place)
        if not Path(place).expanduser().exists():
            raise DataError(
                f"{place} does not exist, the {what} of {folder}; give data_{key}=<where it is now>"
            )
        OmegaConf.update(config, f"data.{key}", place)
    return config


def build_data(config: DictConfig) -> GsganData:
    """The data module of a config, its dataset made if need be, read and checked."""
    lens = str(effect_settings(config).wish("distortion"))
    data: GsganData = instantiate(config.data, distortion=lens)
    data.prepare_data()
    data.setup()
    return data


def effect_settings(config: DictConfig) -> EffectSettings:
    """What a config asks of the effects; a run from before there were any asks nothing.

    Raises:
        ConfigError: on a value that no effect knows.
    """
    if config.get("effects") is None:
        return EffectSettings()
    settings: EffectSettings = instantiate(config.effects)
    return settings


def build_avatar(
    config: DictConfig,
    data: GsganData,
    vertex_labels: Tensor | None = None,
    effects: Effects | None = None,
    labelled: bool | None = None,
) -> Avatar:
    """The untrained avatar of a config, sized to the data, its weights from ``config.seed``.

    Args:
        config: of the run.
        data: whose training split it is for.
        vertex_labels: ``[V]`` the outcome of an earlier class vote; None holds it where it is
            called for.
        effects: decided earlier; None decides them from the training split.
        labelled: whether S was trained on part labels; None: whether the data has some.

    Raises:
        ConfigError: when a value under ``model`` is not one the parts can take.
    """
    if effects is None:
        effects = decide(data.info, effect_settings(config))
    if config.model.get("densify") is not None and "_target_" not in config.model.densify:
        raise ConfigError(
            "experiment=paper changes parts that this model does not have; it goes with "
            "model=full, wo_feat, wo_seg, wo_gcn or splat_only"
        )
    torch.manual_seed(config.seed)
    with _naming("model"):
        return instantiate(config.model)(
            scene=data.info,
            pictures=data.labelled("train"),
            vertex_labels=vertex_labels,
            labelled=labelled,
            effects=effects,
        )


def build_training(config: DictConfig) -> tuple[GsganData, AvatarTraining]:
    """Data and training module of a config.

    Raises:
        GsganError: on a dataset or a value that cannot be used.
    """
    if not isinstance(config.seed, int) or config.seed < 0:
        raise ConfigError(f"seed must be a whole number of at least 0, got {config.seed!r}")
    data = build_data(config)
    avatar = build_avatar(config, data)
    torch.manual_seed(config.seed + DISCRIMINATOR_SALT)  # the same start beside every avatar
    with _naming("training"):
        return data, instantiate(config.training)(avatar, record=training_record(config, data))


def training_record(config: DictConfig, data: GsganData) -> dict[str, Any]:
    """What two parts of one run must have in common: its settings, and the skeletons where
    `gsgan.fit` made them, whose file may be made again under the same name."""
    held = record(config)
    if data.layout.landmarks.fitted_to:
        held["fitted landmarks"] = data.layout.landmarks.digest(data.layout.frames)
    return held


@contextmanager
def _naming(group: str) -> Iterator[None]:
    """A value a constructor refuses becomes a sentence that names the config group."""
    try:
        yield
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(f"{group}: {error}") from error


def load_avatar(folder: Path, config: DictConfig, data: GsganData) -> tuple[Avatar, list[str]]:
    """The trained avatar of a run folder, in eval mode, and the marks its tables must carry.

    Raises:
        DataError: when the checkpoint is missing, damaged, or of another model, or when the data
            lacks what the model was built with.
    """
    path = folder / CHECKPOINT
    checkpoint = read_checkpoint(path)
    prefix = "average.copy.module." if checkpoint["gsgan"].get("averaged") else "avatar."
    state = {
        key.removeprefix(prefix): value
        for key, value in checkpoint["state_dict"].items()
        if key.startswith(prefix)
    }
    decided = checkpoint["gsgan"].get("effects")
    effects = None if decided is None else Effects.from_plain(decided)
    labelled = "segmentation.common" not in state if "segmentation.quats" in state else None
    votes = state.get("segmentation.vertex_labels")
    avatar = build_avatar(config, data, votes, effects, labelled)
    points = effects is not None and effects.body_points.on
    _check_body(folder, avatar, points, segments="segmentation.quats" in state)
    try:
        avatar.load_state_dict(state)
    except RuntimeError as error:
        raise DataError(
            f"{path}: its weights do not fit the config beside it ({folder / '.hydra'})"
        ) from error
    return avatar.eval(), list(checkpoint["gsgan"]["marks"])


def _check_body(folder: Path, avatar: Avatar, points: bool, segments: bool) -> None:
    """Refuses to load what was trained on a body whose model file is no longer given."""
    now = avatar.effects.body_points
    lost = [("S", avatar.segmentation_why)] * (segments and avatar.segmentation is None)
    lost += [("effects.body_points=on", now.why)] * (points and not now.on)
    for what, why in lost:
        raise DataError(
            f"{folder}: trained with {what}, which cannot be built now: {why}; set data.smpl in "
            f"{folder / '.hydra' / 'config.yaml'} to the model file"
        )
