"""The Gaussians of one pose, or of a motion, as OpenUSD's ParticleField3DGaussianSplat."""

import math
import tempfile
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion

from gsgan.export.glb import GENERATOR, to_y_up
from gsgan.export.splats import Splats
from gsgan.utils.errors import ConfigError
from gsgan.utils.provenance import SOURCE_TYPE

NEEDS_USD = "format=usd needs: pip install 'gsgan[usd]'"
REACH = 3.0  # standard deviations of a Gaussian that its extent holds


def refuse_missing_usd() -> None:
    """Raises a ConfigError if the package usd-core is missing, or does not know the schema."""
    try:
        from pxr import UsdVol
    except ImportError:
        raise ConfigError(NEEDS_USD) from None
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise ConfigError(
            f"{NEEDS_USD}; the one that is installed is older than the schema"
        )


def usd_bytes(poses: Iterable[Splats], fps: float, up: str) -> bytes:
    """A binary .usdc file with one prim of Gaussians, ``/Avatar/Gaussians``.

    Lengths are in metres, Y is up, a person in the standard pose faces +Z. Scales and opacities are
    linear. A single pose has values without a time, a motion has time samples from 0 on.

    Args:
        poses: at least one, with the same number of Gaussians.
        fps: of the time samples.
        up: the world's up axis.

    Source: OpenUSD's schema ParticleField3DGaussianSplat (usdVol).
    """
    from pxr import Gf, Usd, UsdGeom, UsdVol

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().customLayerData = {
        "creator": GENERATOR,
        "digitalSourceType": SOURCE_TYPE,
    }

    # A parent turns the world to USD's axes.
    root = UsdGeom.Xform.Define(stage, "/Avatar")
    stage.SetDefaultPrim(root.GetPrim())
    turn = rotation_matrix_to_quaternion(torch.from_numpy(to_y_up(up))[None])[0]
    orient = root.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    orient.Set(Gf.Quatd(*turn.tolist()))
    prim = UsdVol.ParticleField3DGaussianSplat.Define(
        stage, "/Avatar/Gaussians"
    )

    # A first pose alone is written without a time.
    given = iter(poses)
    first = next(given)
    second = next(given, None)
    degree = math.isqrt(first.sh.shape[1]) - 1
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(degree)
    if second is None:
        _set(prim, first, Usd.TimeCode.Default())
    else:
        frame = 0
        for frame, splats in enumerate(chain((first, second), given)):
            _set(prim, splats, Usd.TimeCode(frame))
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(frame)

    # Layers are written to files alone.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.usdc"
        stage.GetRootLayer().Export(str(path))
        return path.read_bytes()


def _set(prim: Any, splats: Splats, time: Any) -> None:
    """Sets the attributes of a pose at a time."""
    from pxr import Vt

    # The box of all Gaussians, each with its reach along its longest axis.
    reach = REACH * splats.scales.max(axis=1, keepdims=True)
    low = (splats.means - reach).min(axis=0)
    high = (splats.means + reach).max(axis=0)
    extent = np.stack([low, high]).astype(np.float32)
    prim.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), time)

    # Arrays of quaternions have the real part last; harmonics follow each other by Gaussian.
    quats = np.roll(splats.quats, -1, axis=1)
    harmonics = splats.sh.reshape(-1, 3)
    values = (
        (prim.CreatePositionsAttr(), Vt.Vec3fArray, splats.means),
        (prim.CreateOrientationsAttr(), Vt.QuatfArray, quats),
        (prim.CreateScalesAttr(), Vt.Vec3fArray, splats.scales),
        (prim.CreateOpacitiesAttr(), Vt.FloatArray, splats.opacities),
        (
            prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(),
            Vt.Vec3fArray,
            harmonics,
        ),
    )
    for attribute, kind, array in values:
        content = np.ascontiguousarray(array, dtype=np.float32)
        attribute.Set(kind.FromNumpy(content), time)
