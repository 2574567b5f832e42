"""Weights as safetensors: what `gsgan.load` needs of a run, in one file without pickle."""

import json
import re
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsgan.model.avatar import Avatar
from gsgan.run.runs import avatar_of
from gsgan.run.stored import read_config
from gsgan.utils.config import config_folder
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.tensors import pick_device

KEPT_FACTS = ("effects", "scene", "marks")  # of a checkpoint's facts
DAMAGED = (
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
    OmegaConfBaseException,
)
NEEDS_SAFETENSORS = "safetensors files need: pip install 'gsgan[export]'"


def weights_bytes(folder: Path, avatar: Avatar, facts: dict[str, Any]) -> bytes:
    """A .safetensors file of the avatar of a run folder.

    Args:
        folder: the run's.
        avatar: its avatar.
        facts: ``gsgan`` of its checkpoint.

    Raises:
        ConfigError: when the package safetensors is missing.
    """
    try:
        from safetensors.torch import save
    except ImportError:
        raise ConfigError(NEEDS_SAFETENSORS) from None

    # The metadata are what an avatar is built from: its config, and facts about its
    # scene.
    config = OmegaConf.to_container(read_config(folder), resolve=False)
    metadata = {"format": "pt", "config": json.dumps(config)}
    metadata["gsgan"] = json.dumps({key: facts.get(key) for key in KEPT_FACTS})
    state = {
        key: value.contiguous() for key, value in avatar.state_dict().items()
    }
    return save(state, metadata)


def load_weights(path: str | Path, *, device: str = "auto") -> Avatar:
    """The frozen avatar of a .safetensors file that `gsgan.export` wrote.

    Args:
        path: the file.
        device: as for `gsgan.load`.

    Raises:
        DataError: when it is missing, damaged, of another program, or names classes of one.
        ConfigError: when the package safetensors is missing.
    """
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError:
        raise ConfigError(NEEDS_SAFETENSORS) from None

    # Weights and metadata, without pickle.
    path = Path(path).expanduser()
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            names = file.keys()
            state = {f"avatar.{name}": file.get_tensor(name) for name in names}
    except (OSError, SafetensorError) as error:
        raise DataError(
            f"{path}: not a readable safetensors file ({error})"
        ) from None

    # The metadata of files by other programs lack these keys.
    if not {"config", "gsgan"} <= metadata.keys():
        raise DataError(
            f"{path}: not written by gsgan.export (its metadata has no config)"
        )

    # A damaged config can fail anywhere in the building of the avatar.
    try:
        config = checked_config(path, json.loads(metadata["config"]))
        checkpoint = {
            "gsgan": json.loads(metadata["gsgan"]),
            "state_dict": state,
        }
        avatar = avatar_of(path, config, checkpoint)
    except DAMAGED as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DataError(
            f"{path}: its metadata is damaged ({reason}); export it again"
        ) from None
    return avatar.to(pick_device(device))


def checked_config(path: Path, plain: Any) -> DictConfig:
    """What an avatar is built from, the model and the seed, of a config that may come from anybody.

    Interpolations are resolved. A config names the classes that it builds: only those in conf/ are
    taken, also where an interpolation makes the name.

    Args:
        path: the file, for messages.
        plain: the config as plain values.

    Raises:
        DataError: when the config names another class, or has an interpolation inside another.
    """
    # The classes that the shipped configs name.
    shipped = "\n".join(
        file.read_text() for file in config_folder().rglob("*.yaml")
    )
    known = {"", *re.findall(r"_target_: *([\w.]+)", shipped)}

    # Every value of the config is visited, however deep it lies.
    config = OmegaConf.create(plain)
    model = OmegaConf.to_container(config["model"], resolve=True)
    pending: list[Any] = [model]
    while pending:
        node = pending.pop()
        if isinstance(node, list):
            pending += node
        elif isinstance(node, dict):
            if node.get("_target_", "") not in known:
                raise DataError(
                    f"{path} names {node['_target_']!r}, which is not a class of gsgan's own "
                    "configs; load the run folder that it was exported from"
                )
            pending += node.values()
        elif isinstance(node, str) and "${" in node:
            # It would be resolved when the avatar is built, after this check.
            raise DataError(
                f"{path}: its config has {node!r} after interpolation; load the run folder that "
                "it was exported from"
            )
    return OmegaConf.create({"model": model, "seed": int(config["seed"])})
