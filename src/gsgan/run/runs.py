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
from omegaconf import DictConfig

from gsgan.body import open_body
from gsgan.body.skinned import MarkedBody
from gsgan.data.scene_info import SceneInfo
from gsgan.effects import Effects
from gsgan.model.avatar import Avatar
from gsgan.run.assemble import build_avatar, build_data
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


def read_avatar(
    folder: Path, smpl: str | None = None
) -> tuple[Avatar, DictConfig, dict[str, Any]]:
    """The trained, frozen avatar of a run folder or of a shared avatar's; its config, and ``gsgan``
    of its checkpoint."""
    # A shared avatar may come from anybody, and be damaged anywhere.
    if is_shared(folder):
        with refusing_damage(folder / CONFIG_FILE):
            config, checkpoint = read_shared(folder)
            avatar = avatar_of(folder, config, checkpoint, smpl)
        return avatar, config, checkpoint["gsgan"]

    # The config says how the avatar is built, and the checkpoint has its weights.
    config = read_config(folder)
    checkpoint = read_checkpoint(folder / CHECKPOINT)
    avatar = avatar_of(folder, config, checkpoint, smpl)
    return avatar, config, checkpoint["gsgan"]


def load_avatar(
    folder: Path, config: DictConfig, data: GsganData
) -> tuple[Avatar, list[str]]:
    """The trained, frozen avatar of a run folder, to render its data, and the marks of its tables.

    Args:
        folder: of the run.
        config: of the run.
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
    return _load_trained(folder, config, checkpoint, scene), marks


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
    config: DictConfig,
    checkpoint: dict[str, Any],
    smpl: str | None = None,
) -> Avatar:
    """The trained, frozen avatar of a checkpoint.

    Args:
        folder: of the run, for messages.
        config: of the run.
        checkpoint: its weights, and what it stores of the scene.
        smpl: as for `load`.
    """
    # The body model file may lie elsewhere than when the avatar was trained.
    scene = read_scene(checkpoint["gsgan"]["scene"])
    file = absolute_path(folder, scene.body_file) if smpl is None else smpl
    return _load_trained(
        folder, config, checkpoint, replace(scene, body_file=file)
    )


def _load_trained(
    folder: Path,
    config: DictConfig,
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
            config, scene, effects=effects, vertex_labels=labels
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
        stored: its config.
        checkpoint: ``gsgan`` of its checkpoint.
        avatar: frozen.
        paths: of its dataset and body model file.
    """

    folder: Path
    stored: DictConfig
    checkpoint: dict[str, Any]
    avatar: Avatar
    paths: DataPaths = field(default_factory=DataPaths)

    @classmethod
    def from_config(cls, config: DictConfig, device: str | None = None) -> Run:
        """The run that a command's config names, on its device or on another.

        Raises:
            ConfigError: when it is not set.
            DataError: when the folder holds no run, or a damaged one.
        """
        if config.run is None:
            raise ConfigError(
                "run is not set: give run=<the folder that gsgan.train printed>"
            )
        paths = DataPaths.from_config(config)
        return cls.load(config.run, paths, device or config.device)

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
        avatar, stored, checkpoint = read_avatar(folder, paths.smpl)
        return cls(
            folder=folder,
            stored=stored,
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
        return build_data(load_config(self.folder, self.paths))

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
