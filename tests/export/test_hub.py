"""``format=hub``: a folder in the form of the Hugging Face Hub, its upload and download."""

import json
import sys

import pytest
import torch
import yaml
from commands import refused
from hub_stand_in import TOKEN, hub_server
from PIL import Image

from gsgan.run.runs import load
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.provenance import verify

FILES = ["README.md", "config.json", "model.safetensors", "preview.png"]


@pytest.fixture
def folder(run, shared, inside):
    """The tiny run as a folder for the Hub."""

    def make(path):
        given = (f"run={run}", "format=hub", f"out={path}", "licence=cc-by-4.0")
        result = inside("export", *given)
        assert result.returncode == 0, result.stdout + result.stderr

    return shared("avatar.v1", make)


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """The stand-in of the Hub in the place of HF_ENDPOINT, with a cache and a token of its own."""
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    with hub_server() as server:
        template = constants.HUGGINGFACE_CO_URL_TEMPLATE.replace(
            constants.ENDPOINT, server.address
        )
        monkeypatch.setattr(constants, "ENDPOINT", server.address)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        yield server


def test_the_folder_gives_the_avatar_back(run, build, folder):
    assert sorted(path.name for path in folder.iterdir()) == FILES
    frame = build()[2]
    given = frame.skeleton, frame.camera
    expected = load(run).render(*given, body=frame.body)
    found = load(folder).render(*given, body=frame.body)
    assert torch.equal(found, expected)


def test_the_folder_says_what_it_is_and_not_where_it_was_made(folder, capture):
    assert verify(folder / "preview.png").synthetic
    with Image.open(folder / "preview.png") as image:
        assert image.size == (32, 32)
        corner = image.getpixel((0, 0))
        assert corner == (255, 255, 255)
        assert image.convert("L").getextrema()[0] < 240  # somebody is there
    for name in ("config.json", "README.md"):
        assert str(capture.parent) not in (folder / name).read_text()


def test_the_card_has_the_scores_in_the_form_of_the_hub(run, folder):
    hub = pytest.importorskip("huggingface_hub")
    card = hub.ModelCard.load(folder / "README.md")
    assert card.data.license == "cc-by-4.0"
    assert "human-avatar" in card.data.tags
    scores = json.loads((run / "metrics.json").read_text())
    found = {
        (result.task_name, result.metric_type): result.metric_value
        for result in card.data.eval_results
    }
    assert found["novel_pose", "psnr"] == scores["novel_pose"]["full"]["psnr"]
    assert "![A rendered pose](preview.png)" in card.text
    assert 'gsgan.load("avatar.v1")' in card.text
    assert "| data |" in card.text  # the training's provenance


def test_upload_then_load_by_name(run, folder, hub, inside, tmp_path):
    given = (f"run={run}", "format=hub", "out=shared", "upload=somebody/me")
    result = inside("export", *given, "private=true")
    assert result.returncode == 0, result.stdout + result.stderr
    assert f"{hub.address}/somebody/me/commit/" in result.stdout
    files = hub.repositories["somebody/me"]
    assert sorted(files) == FILES
    assert hub.created[0]["visibility"] == "private"
    head = yaml.safe_load(hub.cards[0].split("---")[1])
    assert head["model-index"][0]["name"] == "somebody/me"
    assert files["config.json"] == (folder / "config.json").read_bytes()

    # A command takes the name in place of a run folder.
    given = ("run=somebody/me@main", "motion=rest", "frames=1", "out=images")
    result = inside("render", *given)
    assert result.returncode == 0, result.stdout + result.stderr
    assert (tmp_path / "images" / "000000.png").is_file()
    cached = {path.name for path in (tmp_path / "cache").rglob("*.*")}
    assert "model.safetensors" in cached
    assert "preview.png" not in cached

    # What is not there, and what needs the data.
    result = inside("render", "run=somebody/else", "motion=rest", "out=other")
    refused(result, "somebody/else", "no such folder", hub.address)
    given = ("run=somebody/me", "motion=novel_pose", "out=other")
    result = inside("render", *given)
    refused(result, "without its dataset", "motion=")


def test_the_hub_cannot_be_reached(hub):
    hub.shutdown()
    hub.server_close()
    with pytest.raises(DataError, match=f"not found at {hub.address}"):
        load("somebody/me")


def test_an_upload_that_is_not_allowed(bare, hub, inside, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_of_somebody_else")
    given = (f"run={bare}", "format=hub", "out=shared", "upload=somebody/me")
    refused(inside("export", *given), "not accepted", "hf auth login")
    assert hub.repositories == {}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("format=ply", "out=a.ply", "upload=a/b"), "upload requires"),
        (("format=hub", "out=a", "private=true"), "requires upload"),
        (("format=hub", "out=a", "upload=a/b/c"), "upload=a/b/c"),
        (("format=hub",), "needs a folder"),
    ],
)
def test_refusals(given, words, bare, inside):
    pytest.importorskip("huggingface_hub")
    refused(inside("export", f"run={bare}", *given), words)


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ConfigError, match=r"no such folder; .*gsgan\[hub\]"):
        load("somebody/me")


def test_damaged_and_malicious_folders(folder, tmp_path):
    config = json.loads((folder / "config.json").read_text())
    weights = (folder / "model.safetensors").read_bytes()

    def refuse(content: dict, match: str) -> None:
        (tmp_path / "config.json").write_text(json.dumps(content))
        with pytest.raises(DataError, match=match):
            load(tmp_path)

    refuse(config, "model.safetensors: not a readable")
    (tmp_path / "model.safetensors").write_bytes(weights)
    assert load(tmp_path).splats is not None
    refuse({"model_type": "bert"}, "not the config of a gsgan avatar")
    refuse(config | {"gsgan": {}}, "metadata is damaged")
    config["config"]["model"]["deformation"]["_target_"] = "os.getcwd"
    refuse(config, "'os.getcwd', which is not a class")
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(DataError, match="not valid JSON"):
        load(tmp_path)
