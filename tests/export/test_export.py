"""``python -m gsgan.export``: files, cards and refusals of the real command."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import refused
from omegaconf import OmegaConf
from PIL import Image
from safetensors.torch import save_file

from gsgan.export.splats import Splats, ply_bytes
from gsgan.run.runs import marks_of
from gsgan.utils.errors import DataError
from gsgan.utils.provenance import png_bytes


def test_a_sequence_of_ply_files_and_its_card(bare, tmp_path, inside):
    out = tmp_path / "poses"
    given = [f"run={bare}", f"out={out}", "motion=novel_pose"]
    result = inside("export", *given)
    assert result.returncode == 0, result.stderr
    files = sorted(path.name for path in out.iterdir())
    assert files == ["MODEL_CARD.md", "frame000004.ply", "frame000005.ply"]
    first, second = ((out / name).read_bytes() for name in files[1:])
    assert first[:3] == b"ply"
    assert first != second
    card = (out / "MODEL_CARD.md").read_text()
    for part in (
        "Effects",
        "Scores on held-out images",
        "Intended use",
        "Licence",
        "Apache-2.0",
    ):
        assert part in card
    assert "license: other" in card
    refused(inside("export", *given), "exists", "overwrite=true")
    (out / "notes.ply").write_text("mine")
    again = inside(
        "export", *given, "overwrite=true", "licence=cc-by-nc-4.0", "frames=1"
    )
    assert again.returncode == 0, again.stderr
    assert sorted(p.name for p in out.glob("*.ply")) == [
        "frame000004.ply",
        "notes.ply",
    ]
    assert "license: cc-by-nc-4.0" in (out / "MODEL_CARD.md").read_text()


def test_a_ply_says_how_it_is_filtered(bare, tmp_path, inside, monkeypatch):
    """The header has Brush's comment where the avatar was trained with effects.antialias."""

    splats = Splats(
        means=np.zeros((1, 3), np.float32),
        scales=np.ones((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        opacities=np.array([0.5], np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
    )
    line = b"\ncomment SplatRenderMode: mip\n"
    marked, plain = ply_bytes(splats, antialias=True), ply_bytes(splats)
    assert line not in plain
    assert marked.replace(line, b"\n") == plain

    # The command, with and without the effect.
    from gsgan.run.runs import Run

    load = Run.load
    for antialias in (False, True):

        def changed(*given, antialias=antialias):
            run = load(*given)
            accuracy = replace(run.avatar.accuracy, antialias=antialias)
            run.avatar.accuracy = accuracy
            return run

        monkeypatch.setattr(Run, "load", changed)
        out = tmp_path / f"{antialias}.ply"
        result = inside("export", f"run={bare}", f"out={out}")
        assert result.returncode == 0, result.stderr
        header = out.read_bytes().partition(b"end_header")[0]
        assert (line in header) == antialias


def test_a_file_in_place_of_a_folder_and_the_reverse(bare, tmp_path, inside):
    (tmp_path / "poses").write_text("mine")
    (tmp_path / "a.ply").mkdir()
    cases = (
        ("poses", "is a file"),
        ("a.ply", "is a folder"),
        ("poses/a.ply", "cannot be written"),
    )
    for name, words in cases:
        given = (f"run={bare}", f"out={tmp_path / name}", "overwrite=true")
        refused(inside("export", *given), words)


def test_the_rest_pose_as_glb(bare, tmp_path, inside):
    out = tmp_path / "rest.glb"
    result = inside("export", f"run={bare}", "format=gltf", f"out={out}")
    assert result.returncode == 0, result.stderr
    assert out.read_bytes()[:4] == b"glTF"
    assert (
        "KHR_gaussian_splatting"
        in (tmp_path / "rest.glb.MODEL_CARD.md").read_text()
    )


def test_a_trained_run_as_safetensors_with_its_scores(run, tmp_path, inside):
    out = tmp_path / "one.safetensors"
    result = inside("export", f"run={run}", "format=safetensors", f"out={out}")
    assert result.returncode == 0, result.stderr
    card = (tmp_path / "one.safetensors.MODEL_CARD.md").read_text()
    assert "| novel_pose | final image |" in card
    assert "marked: perceptual loss" in card

    # A card that is somebody's own stays.
    other = ("format=gltf", f"out={tmp_path / 'me.glb'}")
    (tmp_path / "me.glb.MODEL_CARD.md").write_text("mine")
    refused(inside("export", f"run={run}", *other), "MODEL_CARD.md exists")
    assert (tmp_path / "me.glb.MODEL_CARD.md").read_text() == "mine"


def test_an_unfinished_run_says_so():
    facts = {"marks": ["a mark"], "step": 4, "planned": 16}
    assert marks_of(facts) == [
        "a mark",
        "unfinished: 4 of 16 iterations are trained",
    ]
    assert marks_of(facts | {"step": 16}) == ["a mark"]


def test_safetensors_name_no_class_but_gsgans_own(run, compose, tmp_path):
    from configs import load_run

    from gsgan.export.weights import load_weights, safetensors_file
    from gsgan.run.stored import read_config

    config = compose("export", f"run={run}", "+device=cpu")
    content = safetensors_file(load_run(config))
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)
    assert load_weights(path).splats is not None
    target = b"gsgan.model.deformation.Deformation"
    for other in (
        b"os.system",
        b"${oc.env:HOME}",
        b"gsgan.utils.files.write_atomically",
    ):
        path.write_bytes(content.replace(target, other.ljust(len(target))))
        with pytest.raises(DataError, match="not a class of gsgan"):
            load_weights(path)

    # An interpolation makes a value, and with it the name of a class.
    for text in (
        "${oc.create:{_target_: os.getcwd}}",
        "\\${oc.create:{_target_: os.getcwd}}",  # resolved, it is the one above
    ):
        config = OmegaConf.to_container(read_config(run))
        config["model"]["supersample"] = text
        tensors = {"a": torch.zeros(1)}
        metadata = {"config": json.dumps(config), "gsgan": "{}"}
        save_file(tensors, path, metadata)
        with pytest.raises(DataError, match="getcwd"):
            load_weights(path)
    path.write_bytes(content.replace(b'\\"model\\"', b'\\"modem\\"'))
    with pytest.raises(DataError, match="metadata is damaged"):
        load_weights(path)


def test_verify_reads_a_file(tmp_path, inside):
    path = tmp_path / "a.png"
    path.write_bytes(png_bytes(Image.new("RGB", (2, 2))))
    result = inside("export", f"verify={path}")
    assert result.returncode == 0, result.stderr
    assert "trainedAlgorithmicMedia" in result.stdout
    refused(
        inside("export", f"verify={tmp_path / 'none.png'}"),
        "none.png",
        "cannot be read",
    )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("out=a.ply", "format=fbx"), ("format", "safetensors")),
        ((), ("out is not set",)),
        (("out=a.glb",), (".ply file or a folder",)),
        (("out=folder", "format=onnx"), (".onnx file",)),
        (("out=a.ply", "motion=none.bvh"), ("none.bvh", "does not exist")),
        (("out=a.ply", "start=9"), ("start=9", "has")),
        (("out=a.glb", "format=gltf", "fps=0", "motion=novel_pose"), ("fps",)),
    ],
)
def test_refusals(given, words, bare, tmp_path, inside):
    refused(inside("export", f"run={bare}", *given), *words)
    assert list(tmp_path.iterdir()) == []


def test_a_body_pose_that_is_missing_is_solved(run, tmp_path, inside):
    out = tmp_path / "a.ply"
    result = inside("export", f"run={run}", "motion=rest", f"out={out}")
    assert result.returncode == 0, result.stderr
    assert out.read_bytes()[:3] == b"ply"
