"""Avatars without their run: a folder with a config and weights, on the disk or on the Hugging Face
Hub."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from safetensors import SafetensorError, safe_open
from torch import Tensor

from gsgan.run.stored import CONFIG, read_config, renew
from gsgan.utils.config import config_folder
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import read_json

# The files of a shared avatar, by the names that the Hub expects.
CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
# Entries of the config file: what the avatar is built from, and facts of its checkpoint.
ENTRIES = {"config", "gsgan"}
FACTS = ("effects", "scene", "marks", "step")
# owner/name, and a branch, tag or commit after @
REPOSITORY = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*(@[\w./-]+)?")
# The avatar that comes with gsgan, its name for `find_avatar`, and a motion for it.
DEMO = "demo"
DEMO_FOLDER = Path(__file__).with_name("demo")
DEMO_MOTION = DEMO_FOLDER / "dance.npz"
NEEDS_HUB = "the Hugging Face Hub needs: pip install 'gsgan[hub]'"
# Errors of code that is given a damaged config or facts.
DAMAGED = (
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
    OmegaConfBaseException,
)


def find_avatar(name: str | Path) -> Path:
    """The folder of an avatar.

    Args:
        name: a run folder, the folder of a shared avatar, ``demo`` for the avatar that comes with
            gsgan, or ``owner/name`` or ``owner/name@revision`` on the Hugging Face Hub, which is
            downloaded into the cache of huggingface_hub. A folder comes before the other names.

    Raises:
        DataError: when the Hub has no such avatar, or cannot be reached.
        ConfigError: when the package huggingface_hub is missing.
    """
    folder = Path(name).expanduser()
    if folder.exists():
        return folder
    if str(name) == DEMO:
        return DEMO_FOLDER
    if REPOSITORY.fullmatch(str(name)):
        return _download(str(name))
    return folder  # its reader says what is missing


def _download(name: str) -> Path:
    try:
        from huggingface_hub import constants, snapshot_download
        from huggingface_hub.errors import HFValidationError, HTTPError
    except ImportError:
        raise ConfigError(f"{name}: no such folder; {NEEDS_HUB}") from None

    # Errors of the network are HTTPError or, where the cache is looked at then, OSError.
    repository, _, revision = name.partition("@")
    try:
        folder = snapshot_download(
            repository,
            revision=revision or None,
            allow_patterns=[CONFIG_FILE, WEIGHTS_FILE],
        )
    except (HTTPError, OSError, HFValidationError) as error:
        raise DataError(
            f"{name}: no such folder, and not found at {constants.ENDPOINT} "
            f"({first_line(error)})"
        ) from None
    return Path(folder)


def first_line(error: BaseException) -> str:
    """The first line of an error of the Hub; the others are advice on its own functions."""
    return str(error).strip().partition("\n")[0]


def is_shared(folder: Path) -> bool:
    """Whether a folder holds a shared avatar, and no run."""
    run = (folder / CONFIG).is_file()
    return (folder / CONFIG_FILE).is_file() and not run


def read_shared(folder: Path) -> tuple[DictConfig, dict[str, Any]]:
    """Config and checkpoint of a shared avatar, with the parts of a run's that an avatar needs.

    Raises:
        DataError: when a file is missing or damaged, or the config names a class of another
            program.
    """
    path = folder / CONFIG_FILE
    content = _read_content(path)
    config = check_config(path, content["config"])
    state, _ = read_weights(folder / WEIGHTS_FILE)
    return config, {"gsgan": content["gsgan"], "state_dict": state}


def own_config(folder: Path) -> DictConfig:
    """`check_config` of a run folder, or of a shared avatar's."""
    if not is_shared(folder):
        return check_config(folder, read_config(folder))
    path = folder / CONFIG_FILE
    return check_config(path, _read_content(path)["config"])


def _read_content(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = read_json(path)
    if not content.keys() >= ENTRIES:
        raise DataError(
            f"{path}: not the config of a gsgan avatar (expected entries "
            f"{', '.join(sorted(ENTRIES))})"
        )
    return content


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The weights of a .safetensors file by their names in a checkpoint, and the file's metadata.

    Raises:
        DataError: when it is missing or damaged.
    """
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            names = file.keys()
            state = {f"avatar.{name}": file.get_tensor(name) for name in names}
    except (OSError, SafetensorError) as error:
        raise DataError(
            f"{path}: not a readable safetensors file ({error})"
        ) from None
    return state, metadata


@contextmanager
def refusing_damage(path: Path) -> Iterator[None]:
    """Turns errors of a damaged config, which can occur anywhere in the building of an avatar, into
    a `DataError`."""
    try:
        yield
    except DAMAGED as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DataError(
            f"{path}: its metadata is damaged ({reason}); export it again"
        ) from None


def check_config(path: Path, plain: Any) -> DictConfig:
    """The part of a config that an avatar is built from, of one that may come from anybody.

    Interpolations are resolved. A config names the classes that it builds: only those in conf/ are
    taken, also where an interpolation makes the name.

    Args:
        path: the file, for messages.
        plain: the config, with the entries model, seed and data.size.

    Raises:
        DataError: when the config names another class, or has an interpolation inside another.
    """
    # The classes that the shipped configs name.
    shipped = "\n".join(
        file.read_text() for file in config_folder().rglob("*.yaml")
    )
    targets = {"", *re.findall(r"_target_: *([\w.]+)", shipped)}

    # Every value of the config is visited, however deep it lies.
    config = OmegaConf.create(plain)
    renew(config)
    model = OmegaConf.to_container(config["model"], resolve=True)
    pending: list[Any] = [model]
    while pending:
        node = pending.pop()
        if isinstance(node, list):
            pending += node
        elif isinstance(node, dict):
            if node.get("_target_", "") not in targets:
                raise DataError(
                    f"{path} names {node['_target_']!r}, which is not a class of gsgan's own "
                    "configs; such an avatar is used by its run folder alone"
                )
            pending += node.values()
        elif isinstance(node, str) and "${" in node:
            # It would be resolved when the avatar is built, after this check.
            raise DataError(
                f"{path}: its config has {node!r} after interpolation; such an avatar is used by "
                "its run folder alone"
            )
    size = OmegaConf.select(config, "data.size")
    return OmegaConf.create(
        {"model": model, "seed": int(config["seed"]), "data": {"size": size}}
    )
