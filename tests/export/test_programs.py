"""ONNX, torch.export and safetensors give the avatar's image."""

import io

import numpy as np
import pytest
import torch
from configs import load_run
from safetensors.torch import save_file

import gsgan
from gsgan.export.programs import (
    PoseAndGenerator,
    onnx_program,
    torch_program,
    unfrozen,
)
from gsgan.export.weights import load_weights, safetensors_file
from gsgan.utils.errors import ConfigError, DataError

PARITY = 1e-3
SHALLOW = (
    "model.generator.multipliers=[1,2]"  # the other levels only repeat these
)
MODELS = {
    "supersampled": ("size.supersample=2", "effects.body_points=off", SHALLOW),
    "full": ("effects.light=on", SHALLOW),
    "no S, no graph": ("model=wo_seg", "model/pose_encoder=linear"),
    "image_to_image": ("model=image_to_image",),
    "lbs": ("model=lbs_splat",),
}


def one_is_fast(*names: str) -> list:
    """The first; the others with the slow tests, for exporters take seconds."""
    return [
        names[0],
        *(pytest.param(name, marks=pytest.mark.slow) for name in names[1:]),
    ]


@pytest.fixture
def painted(build):
    """``painted(overrides…)``: a frozen avatar whose layers all add something, and a frame."""

    def run(*overrides: str):
        _, avatar, frame = build("model.window_margin=null", *overrides)
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            for parameter in avatar.parameters():
                parameter += 0.03 * torch.randn(
                    parameter.shape, generator=generator
                )
        return avatar.freeze(), frame

    return run


def unet_inputs(
    avatar, frame
) -> tuple[dict[str, torch.Tensor], list[torch.Tensor]]:
    """The inputs of an ONNX program for a frame, and the image and alpha to expect."""
    found = {}

    def pose(_, given):
        found.update(zip(("omega", "joints"), given, strict=True))

    def unet(_, __, given):
        names = {
            "F": "features",
            "S": "segmentation",
            "p2d": "skeleton",
            "alpha": "splat_alpha",
        }
        if avatar.splat_channels == 0:
            names = {"F": "skeleton", "S": "segmentation"}
        found.update(
            {names.get(name, name): value for name, value in given.items()}
        )

    hooks = [avatar.pose_encoder.register_forward_pre_hook(pose)]
    hooks += [
        avatar.generator.register_forward_pre_hook(unet, with_kwargs=True)
    ]
    with torch.no_grad():
        painting = avatar(
            frame.skeleton, frame.visibility, frame.camera, frame.body
        )
    for hook in hooks:
        hook.remove()
    given = {
        k: v.contiguous()
        for k, v in found.items()
        if k is not None and v is not None
    }
    return given, [painting.image.clamp(0, 1), painting.alpha.clamp(0, 1)]


@pytest.mark.parametrize("model", one_is_fast(*MODELS)[:-1])
def test_onnx_paints_what_the_avatar_paints(model, painted):
    import onnxruntime

    avatar, frame = painted(*MODELS[model])
    session = onnxruntime.InferenceSession(onnx_program(avatar))
    given, expected = unet_inputs(avatar, frame)
    names = {entry.name for entry in session.get_inputs()}
    made = session.run(None, {name: given[name].numpy() for name in names})
    for got, want in zip(made, expected, strict=True):
        assert np.abs(got - want.numpy()).max() < PARITY
        assert want.std() > 1e-3
    other, _ = PoseAndGenerator(unfrozen(avatar)).inputs()  # of another size
    with torch.no_grad():
        want = PoseAndGenerator(unfrozen(avatar))(**other)
    got = session.run(None, {name: x.numpy() for name, x in other.items()})
    assert np.abs(got[0] - want[0].numpy()).max() < PARITY


@pytest.mark.parametrize(
    "model", one_is_fast("image_to_image", "full", "supersampled", "lbs")
)
def test_torch_export_paints_what_the_avatar_paints(model, painted):
    avatar, frame = painted(*MODELS[model])
    program = torch.export.load(
        io.BytesIO(torch_program(avatar, frame.camera.size))
    ).module()
    camera = frame.camera
    body = (frame.body.theta, frame.body.transl) if avatar.needs_body else ()
    with torch.no_grad():
        want = avatar(frame.skeleton, frame.visibility, camera, frame.body)
        image, alpha = program(
            frame.skeleton,
            frame.visibility,
            camera.K,
            camera.R,
            camera.t,
            *body,
        )
    assert (image - want.image.clamp(0, 1)).abs().max() < PARITY
    assert (alpha - want.alpha.clamp(0, 1)).abs().max() < PARITY
    assert want.image.std() > 1e-3


def test_splat_only_has_no_onnx(painted):
    with pytest.raises(ConfigError, match="generator"):
        onnx_program(painted("model=splat_only")[0])


def test_safetensors_give_the_run_back(run, build, compose, tmp_path):
    avatar, (_, _, frame) = gsgan.load(run), build()
    path = tmp_path / "a.safetensors"
    config = compose("export", f"run={run}", "+device=cpu")
    path.write_bytes(safetensors_file(load_run(config)))
    again = load_weights(path)
    given = frame.skeleton, frame.camera
    assert torch.equal(
        avatar.render(*given, body=frame.body),
        again.render(*given, body=frame.body),
    )
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match="safetensors"):
        load_weights(path)
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(DataError, match="config"):
        load_weights(path)
    with pytest.raises(DataError, match="not a readable"):
        load_weights(tmp_path / "none.safetensors")
