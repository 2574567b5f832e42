"""``format=usd``, checked by OpenUSD's own schema and validators."""

import sys

import numpy as np
import pytest
from commands import refused

from gsgan.export.splats import Splats
from gsgan.utils.provenance import SOURCE_TYPE


@pytest.fixture
def pxr():
    return pytest.importorskip("pxr", reason="usd-core is not installed")


def turned() -> Splats:
    """Two Gaussians with harmonics of degree 1, the second turned by 90 degrees about x."""
    half = np.sqrt(0.5)
    return Splats(
        means=np.array([[0, 0, 0], [1, 2, 3]], np.float32),
        scales=np.full((2, 3), 0.1, np.float32),
        quats=np.array([[1, 0, 0, 0], [half, half, 0, 0]], np.float32),
        opacities=np.array([0.25, 1.0], np.float32),
        sh=np.arange(24, dtype=np.float32).reshape(2, 4, 3),
    )


def opened(content: bytes, folder):
    from pxr import Usd

    path = folder / "a.usdc"
    path.write_bytes(content)
    return Usd.Stage.Open(str(path))


def validated(stage) -> None:
    """The validators that come with OpenUSD find nothing wrong."""
    from pxr import UsdValidation

    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    errors = context.Validate(stage)
    assert [error.GetErrorAsString() for error in errors] == []


def test_attributes_have_the_schemas_types_and_meaning(pxr, tmp_path):
    from gsgan.export.usd import usd_bytes

    stage = opened(usd_bytes([turned()], 30, "z"), tmp_path)
    validated(stage)
    prim = stage.GetPrimAtPath("/Avatar/Gaussians")
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    authored = {x.GetName(): x for x in prim.GetAuthoredAttributes()}
    definition = prim.GetPrimDefinition()
    for name, attribute in authored.items():
        spec = definition.GetSchemaAttributeSpec(name)
        assert attribute.GetTypeName() == spec.typeName
    quat = authored["orientations"].Get()[1]
    assert quat.GetReal() == pytest.approx(np.sqrt(0.5))
    assert list(quat.GetImaginary()) == pytest.approx([np.sqrt(0.5), 0, 0])
    assert authored["radiance:sphericalHarmonicsDegree"].Get() == 1
    harmonics = authored["radiance:sphericalHarmonicsCoefficients"].Get()
    assert np.array(harmonics).tolist() == turned().sh.reshape(-1, 3).tolist()
    low, high = np.array(authored["extent"].Get())
    assert low == pytest.approx([-0.3, -0.3, -0.3])
    assert high == pytest.approx([1.3, 2.3, 3.3])
    data = stage.GetRootLayer().customLayerData
    assert data["digitalSourceType"] == SOURCE_TYPE


@pytest.mark.parametrize("up", ["z", "y", "-y"])
def test_the_worlds_up_axis_becomes_y(pxr, tmp_path, up):
    from pxr import Gf, Usd, UsdGeom

    from gsgan.export.usd import usd_bytes

    stage = opened(usd_bytes([turned()], 30, up), tmp_path)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    prim = UsdGeom.Xformable(stage.GetPrimAtPath("/Avatar"))
    transform = prim.ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    sign = -1 if up.startswith("-") else 1
    axis = Gf.Vec3d(*(sign * (name == up[-1]) for name in "xyz"))
    assert list(transform.TransformDir(axis)) == pytest.approx([0, 1, 0])


def test_a_motion_has_time_samples(pxr, bare, inside, tmp_path):
    from pxr import Usd

    given = (f"run={bare}", "format=usd", "out=a.usdc", "motion=novel_pose")
    result = inside("export", *given, "fps=12")
    assert result.returncode == 0, result.stdout + result.stderr
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    validated(stage)
    prim = stage.GetPrimAtPath("/Avatar/Gaussians")
    positions = prim.GetAttribute("positions")
    assert positions.GetTimeSamples() == [0, 1]
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (12, 1)
    first, second = (np.array(positions.Get(time)) for time in (0, 1))
    assert np.abs(second - first).max() > 0.01  # metres

    # The same Gaussians as in the .ply file of that frame.
    import trimesh

    given = (f"run={bare}", "out=a.ply", "motion=novel_pose")
    assert inside("export", *given).returncode == 0
    ply = trimesh.load(tmp_path / "a.ply")
    assert np.allclose(ply.vertices, first)


def test_without_the_package(monkeypatch, bare, inside):
    monkeypatch.setitem(sys.modules, "pxr", None)
    given = (f"run={bare}", "format=usd", "out=a.usdc")
    refused(inside("export", *given), "gsgan[usd]")
