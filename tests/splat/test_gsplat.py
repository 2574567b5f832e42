"""The gsplat backend, with a mock that draws with our reference; unsupported inputs.

The mock has gsplat 1.5.3's signature and conventions of its documentation: skew is
ignored, K gets no gradient, a covariance is read from its upper triangle. What it draws with the
arguments it gets must be what our own backends draw.
"""

import importlib.util
import logging
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from packaging.requirements import Requirement
from splat_scenes import (
    camera,
    cloud,
    error,
    gradients,
    join,
    leaves,
    loss,
    one,
    turned,
    with_covariances,
)
from stability.cases.case import drawing_backends

from gsgan.scene import Camera, Gaussians
from gsgan.splat import (
    ACCURACY,
    gsplat_backend,
    project,
    rasterise,
    reference,
    resolve_backend,
)

ROOT = Path(__file__).parents[2]
CPU, CUDA = torch.device("cpu"), torch.device("cuda")
STANDARD = ACCURACY["standard"]


class StandIn:
    """A mock of the package: ``rasterization``, and the arguments of its calls."""

    def __init__(self, cap: float = 0.999) -> None:
        self.cap, self.calls = cap, []

    def rasterization(
        self,
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmats,
        Ks,
        width,
        height,
        near_plane=0.01,
        far_plane=1e10,
        radius_clip=0.0,
        eps2d=0.3,
        sh_degree=None,
        packed=True,
        tile_size=16,
        backgrounds=None,
        render_mode="RGB",
        rasterize_mode="classic",
        covars=None,
    ):
        self.calls.append(
            SimpleNamespace(
                **{k: v for k, v in locals().items() if k != "self"}
            )
        )
        B, N = opacities.shape
        assert means.shape == (B, N, 3)
        assert viewmats.shape == (B, 1, 4, 4)
        assert Ks.shape == (B, 1, 3, 3)
        tensors = (
            means,
            quats,
            scales,
            covars,
            opacities,
            colors,
            viewmats,
            Ks,
        )
        assert all(x.dtype == torch.float32 for x in tensors if x is not None)
        assert torch.equal(
            viewmats[..., 3, :], torch.tensor([0.0, 0, 0, 1]).expand(B, 1, 4)
        )
        assert (sh_degree, backgrounds, radius_clip, tile_size) == (
            None,
            None,
            0.0,
            16,
        )
        assert far_plane >= 1e10
        K = Ks[:, 0].detach() * torch.tensor(
            [[1.0, 0, 1], [0, 1, 1], [0, 0, 1]]
        )
        if covars is not None:
            quats = scales = None
            covars = covars.triu() + covars.triu(1).mT
        settings = replace(
            STANDARD,
            near=near_plane,
            low_pass=eps2d,
            antialias={"antialiased": True, "classic": False}[rasterize_mode],
            alpha_max=self.cap,
        )
        # Not by rasterise: skew is in the transform, which is no rotation.
        ellipses = project(
            Gaussians(means, quats, scales, opacities, colors, covars),
            Camera(
                K,
                viewmats[:, 0, :3, :3],
                viewmats[:, 0, :3, 3],
                (height, width),
            ),
            settings,
        )
        images = reference.composite(ellipses, (height, width), settings)
        as_gsplat_has_it = [x.movedim(1, -1).unsqueeze(1) for x in images]
        return *as_gsplat_has_it, {}


def install(monkeypatch, module, device="cpu"):
    """Makes ``import gsplat`` give the module, supported on ``device``."""
    monkeypatch.setitem(sys.modules, "gsplat", module)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(gsplat_backend, "DEVICE", device)
    gsplat_backend._measure_cap.cache_clear()


@pytest.fixture
def mock(monkeypatch):
    module = StandIn()
    install(monkeypatch, module)
    yield module
    gsplat_backend._measure_cap.cache_clear()


def scene(
    shape: str = "quats", channels: int = 3, batch: int = 2
) -> tuple[Gaussians, Camera]:
    gaussians = cloud(30, channels, batch=batch)
    if shape == "covariances":
        gaussians = with_covariances(gaussians)
        skew = torch.randn(
            batch, 30, 3, 3, generator=torch.Generator().manual_seed(0)
        )
        skewed = gaussians.covariances + 1e-3 * (skew - skew.mT).double()
        gaussians = replace(gaussians, covariances=skewed)
    return gaussians.to(torch.float32), turned(camera(batch=batch)).to(
        torch.float32
    )


def drawn(gaussians, cam, backend, settings=STANDARD):
    """The raster and its gradients; none of K, as in gsplat."""
    gaussians, cam = leaves(gaussians), leaves(cam)
    cam.K.requires_grad_(False)
    raster = rasterise(gaussians, cam, settings=settings, backend=backend)
    loss(raster).backward()
    return raster, gradients(gaussians, cam)


def assert_same(got, want, tolerance=2e-5):
    (raster, grads), (want_raster, want_grads) = got, want
    for name, value in vars(want_raster).items():
        assert (getattr(raster, name) is None) == (value is None), name
        if value is None:
            continue
        assert error(getattr(raster, name), value) < tolerance, name
    for name, grad in want_grads.items():
        if name != "K":
            off = (grads[name] - grad).abs().max() / grad.abs().max()
            assert off < 10 * tolerance, name


# --- what it is called with --------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["quats", "covariances"])
@pytest.mark.parametrize("channels", [1, 5])
def test_values_and_gradients_are_those_of_the_reference(mock, shape, channels):
    gaussians, cam = scene(shape, channels)
    assert_same(
        drawn(gaussians, cam, "gsplat"), drawn(gaussians, cam, "reference")
    )
    assert mock.calls[-1].packed is False
    assert (mock.calls[-1].quats is None) == (shape == "covariances")


@pytest.mark.parametrize(
    "changes", [{"antialias": True}, {"low_pass": 1.0}, {"near": 2.0}]
)
def test_the_settings_that_gsplat_takes_are_passed_on(mock, changes):
    gaussians, cam = scene()
    settings = replace(STANDARD, **changes)
    plain = drawn(gaussians, cam, "reference")[0]
    want = drawn(gaussians, cam, "reference", settings)
    assert error(want[0].features, plain.features) > 1e-2
    assert_same(drawn(gaussians, cam, "gsplat", settings), want)


def test_a_camera_far_from_the_origin_costs_no_digits(mock):
    gaussians, cam = scene(batch=1)
    offset = torch.tensor([8192.0, -4096.0, 16384.0])
    gaussians = replace(gaussians, means=gaussians.means + offset)
    cam = replace(cam, t=cam.t - cam.R @ offset)
    assert_same(
        drawn(gaussians, cam, "gsplat"), drawn(gaussians, cam, "reference")
    )
    assert mock.calls[-1].means.abs().max() < 10


def test_unusable_quaternions_are_the_identity_and_length_does_not_matter(mock):
    quats = [(0.0, 0.0, 0.0, 0.0), (1e-30, 0.0, 1e-30, 0.0)]
    quats += [(2e18, 1e18, 0.0, 0.0), (1e-15, 0, 0, 1e-15)]
    gaussians = join(*(one(quat=q, scale=(0.1, 0.2, 0.3)) for q in quats))
    gaussians, cam = gaussians.to(torch.float32), scene(batch=1)[1]
    got, want = (
        drawn(gaussians, cam, "gsplat"),
        drawn(gaussians, cam, "reference"),
    )
    assert error(got[0].features, want[0].features) < 2e-5
    assert mock.calls[-1].quats[0, 0].tolist() == [1, 0, 0, 0]
    assert got[1]["quats"].isfinite().all()
    assert not got[1]["quats"][0, :2].any()


# --- when it draws, and when it does not ---------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"alpha_min": 1e-6}, "alpha_min is 0.00392157, not 1e-06"),
        ({"transmittance_min": 1e-6}, "transmittance_min is 0.0001, not 1e-06"),
        ({"extent": "sigma"}, "extent is opacity, not sigma"),
        ({"fov_clamp": 1.5}, "fov_clamp is 1.3, not 1.5"),
        ({"alpha_max": 0.99}, "alpha_max is 0.999, not 0.99"),
    ],
)
@pytest.mark.parametrize("backend", ["auto", "gsplat"])
def test_it_draws_with_any_settings_and_reports_the_differences(
    mock, backend, changes, message
):
    name, reason = resolve_backend(backend, CPU, replace(STANDARD, **changes))
    assert name == "gsplat"
    assert message in reason
    assert "it stops pixels one layer earlier" in reason
    assert reason.endswith("backend=torch has none.")
    assert reason.count(". ") == 0  # one sentence


def test_auto_uses_it_with_the_default_accuracy_and_logs_once(
    mock, caplog, monkeypatch
):
    monkeypatch.setattr(sys.modules["gsgan.splat.rasterise"], "_logged", set())
    gaussians, cam = scene()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            rasterise(gaussians, cam, settings="high")
    assert mock.calls
    assert [r.message for r in caplog.records].count(
        resolve_backend("auto", CPU, ACCURACY["high"])[1]
    ) == 1


def test_the_cap_is_that_of_the_installed_version(monkeypatch):
    install(monkeypatch, StandIn(cap=0.99))
    reason = resolve_backend("gsplat", CPU, STANDARD)[1]
    assert "alpha_max is 0.99, not 0.999" in reason


def test_hard_cases_are_compared_only_with_its_own_cut_offs(mock):
    assert "gsplat" in drawing_backends(CPU, STANDARD)
    assert "gsplat" not in drawing_backends(CPU, ACCURACY["high"])


def test_auto_reports_how_to_install_it(monkeypatch):
    install(monkeypatch, None, device="cuda")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for backend in ("auto", "gsplat"):
        name, reason = resolve_backend(backend, CUDA, STANDARD)
        assert name == "torch"
        assert "gsplat is not installed: pip install 'gsgan[gsplat]'" in reason


def broken(error):
    def rasterization(**_):
        raise error

    return SimpleNamespace(rasterization=rasterization)


WIDE = "gsplat computes in float32, the settings 'standard' in float64"
BROKEN = "is installed but cannot draw here"
BUILD = """Error building extension 'gsplat_cuda': [1/9] nvcc -c projection.cu
FAILED: projection.cuda.o
csrc/Utils.cuh(12): error: namespace "cub" has no member "Sum"
1 error detected in the compilation
ninja: build stopped: subcommand failed."""


class Older(StandIn):
    """gsplat 1.5.2's asserts: no batch dimensions."""

    def rasterization(
        self, means, quats, scales, opacities, colors, viewmats, Ks, **_
    ):
        N = means.shape[0]
        assert means.shape == (N, 3), means.shape


class Few(StandIn):
    """A build that draws no more than colours."""

    def rasterization(self, means, *args, colors, **given):
        if colors.shape[-1] > 3:
            raise RuntimeError("Unsupported number of channels")
        return super().rasterization(means, *args, colors=colors, **given)


class Newer(StandIn):
    """gsplat 1.6's interface: further arguments with defaults, and another cap."""

    def __init__(self) -> None:
        super().__init__(cap=0.99)

    def rasterization(
        self,
        *args,
        with_ut=False,
        with_eval3d=False,
        global_z_order=True,
        **given,
    ):
        return super().rasterization(*args, **given)


@pytest.mark.parametrize(
    ("module", "device", "dtype", "messages"),
    [
        (StandIn(), "cpu", "float64", [WIDE]),
        (
            StandIn(),
            "cuda",
            "float32",
            ["gsplat runs on CUDA only, the Gaussians are on cpu"],
        ),
        # what sys.modules does with None
        (
            None,
            "cpu",
            "float32",
            [BROKEN, "ModuleNotFoundError: import of gsplat halted"],
        ),
        (
            broken(RuntimeError("no kernel image\nfor this device")),
            "cpu",
            "float32",
            [BROKEN, "(RuntimeError: no kernel image)"],
        ),
        (
            broken(AssertionError()),
            "cpu",
            "float32",
            [BROKEN, "(AssertionError)"],
        ),
        (Older(), "cpu", "float32", [BROKEN, "1.5.3 or newer is needed"]),
        (
            broken(RuntimeError(BUILD)),
            "cpu",
            "float32",
            [BROKEN, 'no member "Sum"', "-c constraints-cuda.txt"],
        ),
        (
            Few(),
            "cpu",
            "float32",
            [BROKEN, "RuntimeError: Unsupported number of channels"],
        ),
    ],
)
def test_where_it_cannot_draw_torch_does(
    monkeypatch, module, device, dtype, messages
):
    install(monkeypatch, module, device)
    name, reason = resolve_backend(
        "gsplat", CPU, replace(STANDARD, dtype=dtype)
    )
    assert name == "torch"
    assert all(message in reason for message in messages)


def unsuited_cases():
    gaussians, cam = scene()
    none = Gaussians(*(x[:, :0] for x in list(vars(gaussians).values())[:5]))
    wide = gaussians.to(torch.float64), cam.to(torch.float64)
    return {
        "Gaussians are float64": wide,
        "zero Gaussians": (none, cam),
        "no gradient for Camera.K": (
            gaussians,
            replace(cam, K=cam.K.clone().requires_grad_()),
        ),
    }


@pytest.mark.parametrize("message", list(unsuited_cases()))
def test_unsupported_inputs_use_torch_and_log_once(
    mock, caplog, monkeypatch, message
):
    monkeypatch.setattr(sys.modules["gsgan.splat.rasterise"], "_logged", set())
    gaussians, cam = unsuited_cases()[message]
    resolve_backend("gsplat", CPU, STANDARD)  # measures the cap
    calls = len(mock.calls)
    with caplog.at_level(logging.WARNING, logger="gsgan"):
        for _ in range(2):
            got = rasterise(gaussians, cam, settings=STANDARD, backend="gsplat")
    assert len(mock.calls) == calls
    want = rasterise(gaussians, cam, settings=STANDARD, backend="torch")
    assert torch.equal(got.features, want.features)
    assert sum(message in record.message for record in caplog.records) == 1


def test_without_gradients_a_camera_may_require_them(mock):
    gaussians, cam = scene()
    with torch.no_grad():
        rasterise(gaussians, leaves(cam), settings=STANDARD, backend="gsplat")
    assert len(mock.calls) == 2  # the cap, and the image


# --- the package itself -------------------------------------------------------------------------

needs_gsplat = pytest.mark.skipif(
    not torch.cuda.is_available() or importlib.util.find_spec("gsplat") is None,
    reason="needs a CUDA device and the gsplat package",
)


@needs_gsplat
@pytest.mark.parametrize("shape", ["quats", "covariances"])
@pytest.mark.parametrize("antialias", [False, True])
def test_the_package_draws_the_same_as_torch(shape, antialias):
    gaussians, cam = (x.to(CUDA) for x in scene(shape))
    # Faint, so that no pixel stops: there gsplat differs.
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.3)
    cap, problem = gsplat_backend._measure_cap(gaussians.means.device)
    assert cap is not None, problem
    settings = replace(STANDARD, alpha_max=cap, antialias=antialias)
    assert (
        resolve_backend("auto", gaussians.means.device, settings)[0] == "gsplat"
    )
    got = drawn(gaussians, cam, "gsplat", settings)
    assert_same(got, drawn(gaussians, cam, "torch", settings), tolerance=1e-3)


def test_the_constraints_of_cuda_are_admitted():
    """pip resolves them; the package index is not asked here."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]["gsplat"]
    requirements = {
        requirement.name: requirement.specifier
        for requirement in map(Requirement, project["dependencies"] + extras)
    }
    lines = (ROOT / "constraints-cuda.txt").read_text().splitlines()
    pinned = [line for line in lines if not line.startswith("#")]
    assert len(pinned) == 3
    for line in pinned:
        name, version = line.split("==")
        assert version in requirements[name], line


def test_the_extra_admits_no_version_without_batches():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    (requirement,) = project["project"]["optional-dependencies"]["gsplat"]
    specifier = Requirement(requirement).specifier
    assert [
        version for version in ("1.5.0", "1.5.2") if version in specifier
    ] == []
    assert "1.5.3" in specifier


def test_a_newer_version_draws_too(monkeypatch):
    install(monkeypatch, Newer())
    assert resolve_backend("gsplat", CPU, STANDARD)[0] == "gsplat"
    gaussians, cam = scene()
    settings = replace(STANDARD, alpha_max=0.99)
    got = gsplat_backend.draw(
        gaussians.to(torch.float32), cam.to(torch.float32), settings
    )[0]
    want = rasterise(
        gaussians, cam, settings=settings, backend="torch"
    ).features
    assert error(got, want) < 1e-4
    gsplat_backend._measure_cap.cache_clear()
