"""Weights as safetensors: what `gsgan.load` needs of a run, in one file without pickle."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from safetensors.torch import save

from gsgan.model.avatar import Avatar
from gsgan.run.assemble import AvatarSettings
from gsgan.run.runs import Run, avatar_of, marks_of
from gsgan.run.shared import (
    ENTRIES,
    FACTS,
    check_config,
    own_config,
    read_weights,
    refusing_damage,
)
from gsgan.utils.errors import DataError
from gsgan.utils.tensors import pick_device


def facts_of(run: Run) -> dict[str, Any]:
    """The facts that an avatar is built from beside its weights, as plain values: entries
    ``config`` and ``gsgan``, see `gsgan.run.shared`.

    Raises:
        DataError: when the config names a class that is not one of gsgan's own configs.
    """
    config = own_config(run.folder)
    # The scene as plain values, with the fields that this version reads.
    facts = run.checkpoint | {"scene": asdict(run.scene)}
    return {
        "config": OmegaConf.to_container(config),
        "gsgan": {key: facts.get(key) for key in FACTS}
        | {"marks": marks_of(facts)},
    }


def safetensors_file(run: Run) -> bytes:
    """A .safetensors file that `load_weights` reads: weights, and `facts_of` as metadata."""
    facts = facts_of(run)
    metadata = {key: json.dumps(value) for key, value in facts.items()}
    return weights_bytes(run.avatar, metadata)


def weights_bytes(avatar: Avatar, metadata: dict[str, str]) -> bytes:
    """A .safetensors file of an avatar's weights."""
    state = {
        key: value.contiguous() for key, value in avatar.state_dict().items()
    }
    return save(state, {"format": "pt"} | metadata)


def load_weights(path: str | Path, *, device: str = "auto") -> Avatar:
    """The frozen avatar of a .safetensors file that `gsgan.export` wrote.

    Args:
        path: the file.
        device: as for `gsgan.load`.

    Raises:
        DataError: when it is missing, damaged, of another program, or names classes of one.
    """
    # Weights and metadata, without pickle.
    path = Path(path).expanduser()
    state, metadata = read_weights(path)

    # The metadata of files by other programs lack these keys.
    if not metadata.keys() >= ENTRIES:
        raise DataError(
            f"{path}: not written by gsgan.export (its metadata has no config)"
        )

    # A damaged config can fail anywhere in the building of the avatar.
    with refusing_damage(path):
        config = check_config(path, json.loads(metadata["config"]))
        checkpoint = {
            "gsgan": json.loads(metadata["gsgan"]),
            "state_dict": state,
        }
        settings = AvatarSettings.from_config(config)
        avatar = avatar_of(path, settings, checkpoint)
    return avatar.to(pick_device(device))
