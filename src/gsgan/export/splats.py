"""The Gaussians of a pose as other programs expect them: scales, quaternions, harmonics in world
axes; written as .ply (3D Gaussian splatting) and as glTF (KHR_gaussian_splatting)."""

import gzip
import math
import struct
from dataclasses import dataclass

import numpy as np
import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from gsgan.export.glb import ARRAY_BUFFER, GENERATOR, GlbContent, to_y_up
from gsgan.model.avatar import Avatar
from gsgan.scene import BodyPose, Gaussians
from gsgan.skeleton.densify import even_sphere
from gsgan.splat.sh import MAX_DEGREE, sh_basis
from gsgan.utils.errors import ConfigError

Float = NDArray[np.float32]

DIRECTIONS = 64  # over which harmonics are fitted; 16 would do for rotations
# metres: covariances are rounded to float32, and eigenvalues may be below 0
THINNEST = 1e-7
FAINTEST = 1e-30  # opacity of Gaussians that are not drawn, for a finite logit
SPZ_MAGIC = 0x5053474E  # the letters NGSP
FRACTION_BITS = 12  # of positions in .spz
COLOUR_SCALE = 0.15  # of harmonics of degree 0 in .spz
EXTENSION = "KHR_gaussian_splatting"
POINTS = 0  # glTF's number of this primitive mode


@dataclass(frozen=True)
class Splats:
    """N Gaussians of one pose.

    Args:
        means: ``[N, 3]`` metres, world frame.
        scales: ``[N, 3]`` metres, standard deviations along the axes.
        quats: ``[N, 4]`` w x y z, unit.
        opacities: ``[N]`` in [0, 1].
        sh: ``[N, (d+1)², 3]`` as `gsgan.splat.sh_to_colour` takes them, world frame.
    """

    means: Float
    scales: Float
    quats: Float
    opacities: Float
    sh: Float


def splats_of(
    avatar: Avatar,
    p: Tensor,
    valid: Tensor,
    body: BodyPose | None,
) -> Splats:
    """Ĝ of a pose: Step I's Gaussians, in Step I's colours.

    Ψ's harmonics turn with the body part. Here they are in world axes, so that other programs
    show the same colours. This is exact for densify's frames, which are rotations. Frames of a
    skinned body shear; their harmonics are the least-squares fit over all directions.

    Args:
        avatar: with Gaussians.
        p: ``[1, J, 3]`` metres, finite.
        valid: ``[1, J]``.
        body: the pose of the skinned body, if the avatar needs it.

    Raises:
        ConfigError: when the avatar has no Gaussians (``image_to_image``).
    """
    gaussians, sh, frames = _pose(avatar, p, valid, body)
    assert gaussians.covariances is not None

    # Covariances are Σ = R diag(s²) Rᵀ. The eigenvectors may be mirrored; R is a rotation.
    values, axes = torch.linalg.eigh(gaussians.covariances[0].double())
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    scales = values.clamp_min(THINNEST**2).sqrt()
    quats = functional.normalize(rotation_matrix_to_quaternion(axes), dim=-1)
    return Splats(
        means=_float32(gaussians.means[0]),
        scales=_float32(scales),
        quats=_float32(quats),
        opacities=_float32(gaussians.opacities[0]),
        sh=_float32(in_world(sh.double(), frames.double())[0]),
    )


def _float32(values: Tensor) -> Float:
    return np.ascontiguousarray(values.float().cpu().numpy())


def _pose(
    avatar: Avatar,
    p: Tensor,
    valid: Tensor,
    body: BodyPose | None,
) -> tuple[Gaussians, Tensor, Tensor]:
    """Ĝ, its harmonics ``[1, N, (d+1)², 3]``, and the frames ``[1, N, 3, 3]`` they are in."""
    eye = p.new_zeros(1, 3)  # colours as seen from there are not used

    # Gaussians that move with the body have colours of their own; their frames are the
    # blended bones.
    if avatar.surface is not None:
        assert body is not None
        A, _ = avatar.surface.points.blend(body)
        return avatar.surface(body, eye), avatar.surface.sh[None], A

    # All others get harmonics from Ψ, in the frames of the points that it moves.
    psi = avatar.deformation
    if psi is None:
        raise ConfigError(
            "this avatar has no Gaussians (model=image_to_image) to export"
        )
    points, residuals = avatar.residuals(p, valid, body)
    return psi.compose(points, residuals, eye), residuals.sh, points.frames


def in_world(sh: Tensor, frames: Tensor) -> Tensor:
    """Harmonics ``[B, N, (d+1)², 3]`` of parts with frames ``[B, N, 3, 3]``, in world axes."""
    degree = math.isqrt(sh.shape[-2]) - 1
    # Constant colours look the same in every frame.
    if degree == 0:
        return sh

    # Colours that the part's harmonics have in its own axes, and the world's harmonics
    # with the same colours in the same directions (least squares).
    world = torch.from_numpy(even_sphere(DIRECTIONS)[1]).to(sh)  # [K, 3]
    part_directions = functional.normalize(
        world @ frames, dim=-1, eps=1e-6
    )  # rows Fᵀ v
    colours = sh_basis(part_directions, degree) @ sh
    return torch.linalg.pinv(sh_basis(world, degree)) @ colours


def ply_bytes(splats: Splats, antialias: bool = False) -> bytes:
    """A binary .ply file as 3D Gaussian splatting writes it (Kerbl et al., 2023).

    Scales are logarithms, opacities logits, and harmonics lie channel by channel with zeros above
    the avatar's degree. Quaternions are w x y z; normals are zero.

    Args:
        splats: N Gaussians.
        antialias: whether opacities compensate for the low-pass filter, see `Accuracy`. A comment
            in Brush's words says so; viewers that do not read it show such Gaussians too opaque.
    """
    # Harmonics above the constant one, padded to the format's fixed degree.
    count = len(splats.means)
    rest = np.zeros((count, 3, (MAX_DEGREE + 1) ** 2 - 1), np.float32)
    rest[..., : splats.sh.shape[1] - 1] = splats.sh[:, 1:].transpose(0, 2, 1)

    # Logits are finite for an opacity of 1 too: it is clipped in float64, below 1.
    opacities = splats.opacities.astype(np.float64).clip(FAINTEST)
    logits = np.log(opacities) - np.log1p(-opacities.clip(max=1 - 1e-12))

    # Columns, and the prefix under which each block's properties are numbered.
    numbered = {
        "f_dc": splats.sh[:, 0],
        "f_rest": rest.reshape(count, -1),
        "opacity": logits[:, None],
        "scale": np.log(splats.scales.astype(np.float64)),
        "rot": splats.quats,
    }
    names = ["x", "y", "z", "nx", "ny", "nz"]
    for prefix, values in numbered.items():
        if prefix == "opacity":
            names.append(prefix)
        else:
            names += [f"{prefix}_{i}" for i in range(values.shape[1])]

    # The header declares one float per property; the rows follow in the same order.
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {GENERATOR}",
    ]
    if antialias:
        header.append("comment SplatRenderMode: mip")
    header.append(f"element vertex {count}")
    header += [f"property float {name}" for name in names]
    columns = [splats.means, np.zeros((count, 3)), *numbered.values()]
    rows = np.concatenate(columns, axis=1).astype("<f4")
    return "\n".join([*header, "end_header\n"]).encode() + rows.tobytes()


def splat_bytes(splats: Splats) -> bytes:
    """A .splat file: 32 bytes for each Gaussian, the most visible ones first.

    Positions and scales are floats, colours and opacities bytes, quaternions w x y z as bytes about
    128. Colours are those from all directions: the format has no harmonics. Axes are the world's.

    Source: the viewer by Kevin Kwok (antimatter15/splat), 2023.
    """
    colours = np.clip(0.5 + sh_basis_constant() * splats.sh[:, 0], 0, 1)
    rows = np.zeros(
        len(splats.means),
        [("mean", "<3f4"), ("scale", "<3f4"), ("rgba", "4u1"), ("quat", "4u1")],
    )
    rows["mean"] = splats.means
    rows["scale"] = splats.scales
    rgba = np.c_[colours, splats.opacities]
    rows["rgba"] = np.rint(255 * rgba)
    rows["quat"] = np.rint(splats.quats * 128 + 128).clip(0, 255)

    # Viewers draw the first part of a file before the rest has come.
    size = splats.opacities * splats.scales.prod(axis=1)
    return rows[np.argsort(-size, kind="stable")].tobytes()


def spz_bytes(splats: Splats, up: str, antialias: bool = False) -> bytes:
    """A .spz file of version 2: quantised columns, compressed by gzip.

    The world, whose up axis is ``up``, is turned to Y up, as the format has it. Positions have 24
    bits, of which 12 are fractions of a metre; all other numbers have 8, harmonics fewer.

    Args:
        splats: N Gaussians.
        up: of their world.
        antialias: whether opacities compensate for the low-pass filter, see `Accuracy`.

    Source: github.com/nianticlabs/spz.
    """
    # Everything in axes with Y up.
    count = len(splats.means)
    turn = to_y_up(up)
    means = splats.means @ turn.T
    axes = Rotation.from_quat(np.roll(splats.quats, -1, axis=1))
    quats = (Rotation.from_matrix(turn) * axes).as_quat()
    quats *= np.where(quats[:, 3:] < 0, -1.0, 1.0)
    frames = torch.from_numpy(turn).expand(1, count, 3, 3)
    sh = in_world(torch.from_numpy(splats.sh).double()[None], frames)[0].numpy()

    # Positions as whole numbers of three bytes.
    fixed = np.rint(means * (1 << FRACTION_BITS)).astype("<i4")
    positions = fixed[..., None].view(np.uint8).reshape(count, 3, 4)[..., :3]

    # Colours of degree 0, logarithms of scales, and the vector part of quaternions.
    colours = 255 * (COLOUR_SCALE * sh[:, 0] + 0.5)
    scales = 16 * (np.log(splats.scales.astype(np.float64)) + 10)

    # Of the harmonics above, degree 1 keeps 5 bits and all others 4.
    rest = 128 + 128 * sh[:, 1:]
    steps = np.where(np.arange(rest.shape[1]) < 3, 8, 16)[None, :, None]
    rest = np.floor((rest + steps / 2) / steps) * steps
    columns = [
        255 * splats.opacities,
        colours,
        scales,
        127.5 + 127.5 * quats[:, :3],
        rest,
    ]
    degree = math.isqrt(splats.sh.shape[1]) - 1
    header = struct.pack(
        "<IIIBBBB", SPZ_MAGIC, 2, count, degree, FRACTION_BITS, antialias, 0
    )
    parts = [header, positions.tobytes()]
    for column in columns:
        parts.append(np.rint(column).clip(0, 255).astype(np.uint8).tobytes())
    return gzip.compress(b"".join(parts), mtime=0)


def sh_basis_constant() -> float:
    """The harmonic of degree 0, the same in all directions."""
    return float(sh_basis(torch.tensor([[0.0, 0.0, 1.0]]), 0)[0, 0])


def glb_bytes(splats: Splats, up: str) -> bytes:
    """A binary glTF file of one point primitive with KHR_gaussian_splatting.

    Scales and opacities are linear, quaternions x y z w. A node turns the world, whose up axis is
    ``up``, to glTF's: Y up, a person in the standard pose faces +Z.

    Source: KHR_gaussian_splatting, the release candidate of 2026, kernel ``ellipse``.
    """
    # One attribute per property, and one per spherical harmonic.
    degree = math.isqrt(splats.sh.shape[1]) - 1
    arrays = {
        "POSITION": splats.means,
        f"{EXTENSION}:ROTATION": np.roll(splats.quats, -1, axis=1),
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": splats.opacities[:, None],
    }
    for l in range(degree + 1):
        for m in range(2 * l + 1):
            arrays[f"{EXTENSION}:SH_DEGREE_{l}_COEF_{m}"] = splats.sh[
                :, l * l + m
            ]

    # All attributes lie one after the other in a single buffer.
    glb = GlbContent()
    attributes = {}
    for name, array in arrays.items():
        attributes[name] = glb.add(array.astype("<f4"), ARRAY_BUFFER)

    # The extension says how the points are drawn.
    primitive = {
        "mode": POINTS,
        "attributes": attributes,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
            },
        },
    }

    # A node turns the world to glTF's axes.
    turn = rotation_matrix_to_quaternion(torch.from_numpy(to_y_up(up))[None])[0]
    w, x, y, z = turn.tolist()

    # The scene: one node with one mesh, which has one primitive.
    return glb.file(
        {
            "extensionsUsed": [EXTENSION],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "rotation": [x, y, z, w]}],
            "meshes": [{"primitives": [primitive]}],
        }
    )
