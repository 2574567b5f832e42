"""Accuracy presets, their configs, and the choice of a backend."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from splat_scenes import camera, cloud, needs_native

from gsgan.splat import ACCURACY, accuracy, rasterise, resolve_backend

CONF = Path(__file__).parents[2] / "conf" / "accuracy"
CPU = torch.device("cpu")


def test_every_preset_is_a_config_and_every_config_a_preset():
    assert {path.stem for path in CONF.glob("*.yaml")} == set(ACCURACY)


def test_values_of_the_presets():
    table = {
        name: (s.alpha_min, s.transmittance_min, s.extent)
        for name, s in ACCURACY.items()
    }
    assert table == {
        "exact": (0, 0, "all"),
        "high": (1e-5, 1e-5, "opacity"),
        "standard": (1 / 255, 1e-4, "opacity"),
        "draft": (1 / 64, 1e-2, "sigma"),
    }
    assert [s.torch_dtype for s in ACCURACY.values()] == [torch.float64] + [
        torch.float32
    ] * 3
    assert {s.near for s in ACCURACY.values()} == {0.01}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("alpha_min", -0.1),
        ("transmittance_min", 1.0),
        ("extent", "box"),
        ("dtype", "float16"),
        ("radius_sigmas", 0.0),
        ("near", 0.0),
        ("alpha_max", 1.01),
        ("low_pass", 0.0),
        ("fov_clamp", 0.9),
        ("supersample", 0),
        ("supersample", 2.0),
    ],
)
def test_values_out_of_range_are_refused(field, value):
    with pytest.raises(ValueError, match=f"Accuracy.*{field}"):
        replace(ACCURACY["high"], **{field: value})


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="exact, high, standard, draft"):
        accuracy("best")
    with pytest.raises(ValueError, match=r"backend.*auto"):
        resolve_backend("gpu", CPU, ACCURACY["high"])


def test_exact_uses_the_reference_unless_a_backend_is_requested():
    assert resolve_backend("auto", CPU, ACCURACY["exact"]) == ("reference", "")
    assert resolve_backend("torch", CPU, ACCURACY["exact"]) == ("torch", "")


def test_cuda_does_not_use_native():
    name, reason = resolve_backend(
        "native", torch.device("cuda"), ACCURACY["high"]
    )
    assert name == "torch"
    assert "CPU only" in reason


@needs_native
def test_cpu_uses_native():
    assert resolve_backend("auto", CPU, ACCURACY["high"]) == ("native", "")


def test_a_missing_kernel_falls_back_and_logs_once(monkeypatch, caplog):
    from gsgan.splat import native

    monkeypatch.setattr(native, "available", lambda: False)
    monkeypatch.setattr(
        native, "why_not", lambda: "there is no compiler for test 4711."
    )
    name, reason = resolve_backend("auto", CPU, ACCURACY["high"])
    assert name == "torch"
    assert reason.endswith("there is no compiler for test 4711.")
    with caplog.at_level(logging.WARNING, logger="gsgan"):
        for _ in range(3):
            rasterise(cloud(3), camera((4, 4)), settings="high")
    assert sum("4711" in record.message for record in caplog.records) == 1


@pytest.mark.parametrize("name", list(ACCURACY))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_output_has_the_dtype_of_the_input(name, dtype):
    gaussians, cam = cloud(3, dtype=dtype), camera((4, 4), dtype=dtype)
    raster = rasterise(gaussians, cam, settings=name)
    assert raster.features.dtype == raster.alpha.dtype == dtype


def test_exact_computes_float32_inputs_in_float64():
    gaussians, cam = (
        cloud(200, dtype=torch.float32),
        camera(dtype=torch.float32),
    )
    got = rasterise(gaussians, cam, settings="exact").features
    want = rasterise(
        gaussians.to(torch.float64), cam.to(torch.float64), settings="exact"
    ).features
    assert torch.equal(got, want.float())
