"""Trained avatars: `load` for users, `Run` for commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf

from gsgan.body import open_body
from gsgan.body.skinned import MarkedBody
from gsgan.data.scene_info import SceneInfo
from gsgan.effects import Effects
from gsgan.model.avatar import Avatar
from gsgan.run.assemble import AvatarSettings, RunSettings, build_avatar
from gsgan.run.shared import (
    CONFIG_FILE,
    find_avatar,
    is_shared,
    read_shared,
    refusing_damage,
)
from gsgan.run.stored import (
    CHECKPOINT,
    DataPaths,
    absolute_path,
    load_config,
    read_checkpoint,
    read_config,
    read_scene,
)
from gsgan.skeleton import HOLISTIC
from gsgan.skeleton.proportions import Proportions
from gsgan.skeleton.tensors import constants
from gsgan.utils.config import CommandOptions
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.tensors import pick_device

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData  # loads lightning

Float = NDArray[np.float64]


def load(
    run: str | Path, *, smpl: str | Path | None = None, device: str = "auto"
) -> Avatar:
    """A trained, frozen avatar, to `render`; the dataset is not needed.

    Args:
        run: the folder that ``gsgan.train`` printed, or an avatar that was shared: a folder that
            ``gsgan.export format=hub`` wrote, or ``owner/name`` or ``owner/name@revision`` on the
            Hugging Face Hub. A folder comes before a name on the Hub.
        smpl: the body model file, if the run read one and it has moved or was not shared.
        device: ``auto``, ``cpu``, ``cuda`` or another torch device.

    Raises:
        GsganError: when the folder holds no run or no checkpoint, its checkpoint is damaged, the
            Hub has no such avatar, or the model file is missing.
    """
    folder = find_avatar(run)
    avatar, _, _ = read_avatar(folder, None if smpl is None else str(smpl))
    return avatar.to(pick_device(device))


@dataclass(frozen=True)
class TrainedAs:
    """What else a run's config says of its avatar.

    Args:
        image_size: pixels of the training images; None: sizes of their own.
        seed: of the run, or None.
        character: of the default person's dataset, or None.
    """

    image_size: int | None
    seed: int | None
    character: str | None


def read_avatar(
    folder: Path, smpl: str | None = None
) -> tuple[Avatar, TrainedAs, dict[str, Any]]:
    """The trained, frozen avatar of a run folder or of a shared avatar's; facts of its config, and
    ``gsgan`` of its checkpoint."""
    # A shared avatar may come from anybody, and be damaged anywhere.
    if is_shared(folder):
        with refusing_damage(folder / CONFIG_FILE):
            config, checkpoint = read_shared(folder)
            settings = AvatarSettings.from_config(config)
            avatar = avatar_of(folder, settings, checkpoint, smpl)
    else:
        # The config says how the avatar is built, and the checkpoint has its weights.
        config = read_config(folder)
        checkpoint = read_checkpoint(folder / CHECKPOINT)
        settings = avatar_settings(folder, config)
        avatar = avatar_of(folder, settings, checkpoint, smpl)
    trained_as = TrainedAs(
        image_size=OmegaConf.select(config, "data.size"),
        seed=config.get("seed"),
        character=OmegaConf.select(config, "data.source.avatar"),
    )
    return avatar, trained_as, checkpoint["gsgan"]


def avatar_settings(folder: Path, config: DictConfig) -> AvatarSettings:
    """What the config of a run folder says of its avatar.

    Raises:
        DataError: when nothing can be built from it.
    """
    try:
        return AvatarSettings.from_config(config)
    except ConfigError as error:
        raise DataError(
            f"{folder}: no avatar can be built from its config: {error}"
        ) from error


def load_avatar(
    folder: Path, settings: AvatarSettings, data: GsganData
) -> tuple[Avatar, list[str]]:
    """The trained, frozen avatar of a run folder, to render its data, and the marks of its tables.

    Args:
        folder: of the run.
        settings: of its config.
        data: its dataset, from which the body model file and the order of the cameras are taken.
    """
    # Facts that depend on where the data is now replace the stored ones.
    checkpoint = read_checkpoint(folder / CHECKPOINT)
    body = data.layout.meta.body
    scene = replace(
        read_scene(checkpoint["gsgan"]["scene"]),
        body_file=None if body is None else body.file,
        camera_names=data.layout.camera_names,
    )
    marks = marks_of(checkpoint["gsgan"])
    return _load_trained(folder, settings, checkpoint, scene), marks


def marks_of(facts: Mapping[str, Any]) -> list[str]:
    """Notes that must accompany what a checkpoint's avatar renders and its scores."""
    marks = list(facts.get("marks") or ())
    planned = facts.get("planned") or 0
    if facts["step"] < planned:
        marks.append(
            f"unfinished: {facts['step']} of {planned} iterations are trained"
        )
    return marks


def avatar_of(
    folder: Path,
    settings: AvatarSettings,
    checkpoint: dict[str, Any],
    smpl: str | None = None,
) -> Avatar:
    """The trained, frozen avatar of a checkpoint.

    Args:
        folder: of the run, for messages.
        settings: of its config.
        checkpoint: its weights, and what it stores of the scene.
        smpl: as for `load`.
    """
    # The body model file may lie elsewhere than when the avatar was trained.
    scene = read_scene(checkpoint["gsgan"]["scene"])
    file = absolute_path(folder, scene.body_file) if smpl is None else smpl
    return _load_trained(
        folder, settings, checkpoint, replace(scene, body_file=file)
    )


def _load_trained(
    folder: Path,
    settings: AvatarSettings,
    checkpoint: dict[str, Any],
    scene: SceneInfo,
) -> Avatar:
    # The avatar's weights: the averaged ones, once averaging has begun.
    stored = checkpoint["gsgan"]
    prefix = "average.copy.module." if stored.get("averaged") else "avatar."
    state = {
        key.removeprefix(prefix): value
        for key, value in checkpoint["state_dict"].items()
        if key.startswith(prefix)
    }

    # The avatar is built as when training began, with the labels that were voted then.
    labels = state.get("segmentation.vertex_labels")
    effects = Effects.from_plain(stored["effects"])
    try:
        avatar = build_avatar(
            settings, scene, effects=effects, vertex_labels=labels
        )
    except (TypeError, ValueError, OverflowError) as error:
        reason = str(error).split("\n")[0]
        raise DataError(
            f"{folder}: no avatar can be built from its config: {reason}"
        ) from error

    # S is missing if its body cannot be opened; the weights would not fit.
    if "segmentation.quats" in state and avatar.segmentation is None:
        raise DataError(
            f"{folder}: trained with S, which cannot be built now: {avatar.segmentation_why}; give "
            "the body model file (smpl=, or data_smpl= on the command line)"
        )

    # The weights do not fit if the config was changed after the training.
    try:
        avatar.load_state_dict(state)
    except RuntimeError as error:
        raise DataError(
            f"{folder}: the weights do not fit the config"
        ) from error
    return avatar.freeze()


@dataclass
class Run:
    """A run folder, or a shared avatar; the dataset is opened only where it is needed.

    Args:
        folder: of the run.
        trained_as: facts of its config.
        checkpoint: ``gsgan`` of its checkpoint.
        avatar: frozen.
        paths: of its dataset and body model file.
    """

    folder: Path
    trained_as: TrainedAs
    checkpoint: dict[str, Any]
    avatar: Avatar
    paths: DataPaths = field(default_factory=DataPaths)

    @classmethod
    def load(
        cls,
        name: str | Path,
        paths: DataPaths | None = None,
        device: str = "auto",
    ) -> Run:
        """A run folder, or a shared avatar.

        Args:
            name: as ``run`` of `load`.
            paths: of its dataset and body model file, if they have moved.
            device: as for `load`.

        Raises:
            DataError: when the folder holds no run, or a damaged one.
        """
        # The dataset itself is opened later, and only by commands that need it.
        folder = find_avatar(name)
        paths = paths or DataPaths()
        avatar, trained_as, checkpoint = read_avatar(folder, paths.smpl)
        return cls(
            folder=folder,
            trained_as=trained_as,
            checkpoint=checkpoint,
            avatar=avatar.to(pick_device(device)),
            paths=paths,
        )

    @property
    def is_shared(self) -> bool:
        """Whether it is a shared avatar, which has no dataset."""
        return is_shared(self.folder)

    @cached_property
    def data(self) -> GsganData:
        """The run's dataset.

        Raises:
            DataError: when it is missing, as it is for every shared avatar.
        """
        if self.is_shared:
            raise DataError(
                f"{self.folder}: a shared avatar comes without its dataset; give motion=<file> or "
                "motion=rest, and camera=orbit or a calibration file"
            )
        config = load_config(self.folder, self.paths)
        return RunSettings.from_config(config).data.read()

    @property
    def scene(self) -> SceneInfo:
        """Facts about the scene."""
        return read_scene(self.checkpoint["scene"])

    @property
    def body(self) -> MarkedBody | None:
        """The skinned body that the avatar moves with, in the subject's shape, or None."""
        # Avatars on the skeleton alone have none.
        if not self.avatar.needs_body:
            return None
        return open_body(self.scene.body, self.body_file, self.scene.betas)

    @property
    def body_file(self) -> str | None:
        """The user's model file of the body, or None."""
        return self.paths.smpl or absolute_path(
            self.folder, self.scene.body_file
        )

    @property
    def proportions(self) -> Proportions:
        """The subject's proportions."""
        assert self.scene.proportions is not None
        return self.scene.proportions

    @property
    def face(self) -> Float:
        """``[30, 3]`` metres: the subject's face at rest, see `gsgan.skeleton.in_head`; the
        template's for avatars without a face."""
        # Without a face of its own the avatar gets the template's.
        template = self.avatar.template
        template = template if template.expression else HOLISTIC
        return constants(
            template, torch.device("cpu"), torch.float64
        ).face_rest.numpy()


@dataclass(frozen=True)
class RunReference(CommandOptions):
    """The options of a command that name a run, and where its dataset and model file are now."""

    run: str | None
    data_root: str | None
    data_smpl: str | None
    device: str = "auto"

    @property
    def paths(self) -> DataPaths:
        """The paths of the dataset and of the body model file."""
        return DataPaths(self.data_root, self.data_smpl)

    def load(self) -> Run:
        """The run, on the device.

        Raises:
            ConfigError: when it is not set.
            DataError: when the folder holds no run, or a damaged one.
        """
        if self.run is None:
            raise ConfigError(
                "run is not set: give run=<the folder that gsgan.train printed>"
            )
        return Run.load(self.run, self.paths, self.device)
