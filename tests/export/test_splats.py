"""Exported Gaussians: what other programs read is what the avatar draws."""

import gzip
import io

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from gsgan.export.glb import to_y_up
from gsgan.export.splats import (
    Splats,
    glb_bytes,
    in_world,
    ply_bytes,
    splat_bytes,
    splats_of,
    spz_bytes,
)
from gsgan.scene import Gaussians
from gsgan.splat import rasterise, sh_to_colour

NAMES = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
NAMES += [*(f"f_rest_{i}" for i in range(45)), "opacity"]
NAMES += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


@pytest.fixture
def posed(build):
    """An avatar with weights of some size, and a frame: ``posed(overrides…)``."""

    def run(*overrides: str):
        _, avatar, frame = build(*overrides)
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            for parameter in avatar.splats.parameters():
                parameter += 0.05 * torch.randn(
                    parameter.shape, generator=generator
                )
        for part in avatar.modules():
            if hasattr(part, "active_degree"):
                part.active_degree = part.sh_degree
        return avatar.freeze(), frame

    return run


def splats_and_truth(avatar, frame) -> tuple[Splats, Gaussians]:
    with torch.no_grad():
        splats = splats_of(
            avatar, frame.skeleton, frame.visibility > 0, frame.body
        )
        painting = avatar(
            frame.skeleton, frame.visibility, frame.camera, frame.body
        )
    return splats, painting.gaussians


def read_ply(content: bytes) -> Gaussians:
    """As 3D Gaussian splatting's own reader: sigmoid, exp, harmonics channel by channel."""
    raw = trimesh.load(io.BytesIO(content), "ply", process=False).metadata[
        "_ply_raw"
    ]["vertex"]
    assert raw["length"] == len(raw["data"]["x"])
    assert list(raw["properties"]) == NAMES
    column = {
        name: torch.from_numpy(np.array(raw["data"][name]).reshape(-1))
        for name in NAMES
    }

    def rows(*names: str) -> torch.Tensor:
        return torch.stack([column[name] for name in names], dim=-1)

    rest = rows(*NAMES[9:54]).unflatten(-1, (3, 15)).mT
    sh = torch.cat([rows(*NAMES[6:9])[:, None], rest], dim=1)
    return Gaussians(
        rows("x", "y", "z")[None],
        rows(*NAMES[-4:])[None],
        rows(*NAMES[-7:-4]).exp()[None],
        column["opacity"].sigmoid()[None],
        sh.flatten(1)[None],
    )


def covariances(gaussians: Gaussians) -> np.ndarray:
    x, y, z, w = np.roll(gaussians.quats[0].numpy(), -1, axis=1).T
    turn = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    axes = turn * gaussians.scales[0].double().numpy()[:, None]
    return axes @ axes.transpose(0, 2, 1)


CASES = {
    "densify": ("effects.body_points=off", "effects.view_dependence=2"),
    "on the body": ("effects.body_points=on", "effects.view_dependence=0"),
    "lbs": ("model=lbs_splat", "effects.view_dependence=1"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_ply_read_back_is_the_gaussians(case, posed):
    avatar, frame = posed(*CASES[case])
    splats, truth = splats_and_truth(avatar, frame)
    read = read_ply(ply_bytes(splats))
    torch.testing.assert_close(read.means, truth.means)
    torch.testing.assert_close(read.opacities, truth.opacities)
    known = truth.covariances[0].numpy()
    largest = np.abs(known).max(axis=(1, 2), keepdims=True)
    assert (np.abs(covariances(read) - known) / largest).max() < 2e-6
    view = torch.nn.functional.normalize(
        truth.means - frame.camera.centre[:, None], dim=-1
    )
    colour = sh_to_colour(read.features.unflatten(-1, (16, 3)), view).clamp_min(
        0
    )
    # frames of a skinned body shear: their harmonics are fitted
    tolerance = 0.02 if case == "lbs" else 2e-5
    assert (colour - truth.features[..., :3]).abs().max() < tolerance
    assert truth.features[..., :3].std() > 0.01


def test_a_ply_drawn_is_step_ones_image(posed):
    avatar, frame = posed(*CASES["densify"])
    splats, _ = splats_and_truth(avatar, frame)
    read = read_ply(ply_bytes(splats))
    view = read.means - frame.camera.centre[:, None]
    colour = sh_to_colour(read.features.unflatten(-1, (16, 3)), view).clamp_min(
        0
    )
    read = Gaussians(
        read.means, read.quats, read.scales, read.opacities, colour
    )
    drawn = rasterise(read, frame.camera, settings=avatar.accuracy)
    avatar.window_margin = None
    with torch.no_grad():
        painting = avatar(
            frame.skeleton, frame.visibility, frame.camera, frame.body
        )
    assert (drawn.features - painting.features[:, :3]).abs().max() < 1e-4


def test_harmonics_turn_with_their_part():
    generator = torch.Generator().manual_seed(0)
    sh = torch.randn(1, 5, 16, 3, generator=generator, dtype=torch.float64)
    turns = torch.from_numpy(Rotation.random(5, random_state=0).as_matrix())[
        None
    ]
    view = torch.randn(1, 5, 3, generator=generator, dtype=torch.float64)
    own = (turns.mT @ view[..., None])[..., 0]
    torch.testing.assert_close(
        sh_to_colour(in_world(sh, turns), view), sh_to_colour(sh, own)
    )


def test_what_is_not_drawn_has_finite_numbers():
    one = np.ones((2, 3), np.float32)
    opacities = np.array([0, 1], np.float32)
    splats = Splats(
        one, one, np.eye(4, dtype=np.float32)[:2], opacities, one[:, None]
    )
    read = read_ply(ply_bytes(splats))
    assert all(torch.isfinite(x).all() for x in (read.opacities, read.features))
    np.testing.assert_allclose(read.opacities[0], opacities, atol=1e-7)


def test_a_glb_holds_the_same_gaussians(posed):
    avatar, frame = posed(*CASES["densify"])
    splats, truth = splats_and_truth(avatar, frame)
    gltf = pygltflib.GLTF2.load_from_bytes(glb_bytes(splats, "-y"))
    assert gltf.extensionsUsed == ["KHR_gaussian_splatting"]
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.mode == pygltflib.POINTS
    kernel = primitive.extensions["KHR_gaussian_splatting"]
    assert kernel == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    read = {}
    for name, at in vars(primitive.attributes).items():
        if at is None:
            continue
        accessor = gltf.accessors[at]
        view = gltf.bufferViews[accessor.bufferView]
        raw = gltf.binary_blob()[
            view.byteOffset : view.byteOffset + view.byteLength
        ]
        read[name.removeprefix("KHR_gaussian_splatting:")] = np.frombuffer(
            raw, "<f4"
        ).reshape(accessor.count, -1)
    harmonics = [
        f"SH_DEGREE_{l}_COEF_{m}" for l in range(3) for m in range(2 * l + 1)
    ]
    assert set(read) == {"POSITION", "ROTATION", "SCALE", "OPACITY", *harmonics}
    np.testing.assert_array_equal(
        np.stack([read[n] for n in harmonics], 1), splats.sh
    )
    np.testing.assert_array_equal(read["POSITION"], truth.means[0])
    np.testing.assert_allclose(read["OPACITY"][:, 0], truth.opacities[0])
    turn = Rotation.from_quat(
        read["ROTATION"]
    ).as_matrix()  # x y z w, as glTF has it
    axes = turn * read["SCALE"][:, None]
    known = truth.covariances[0].numpy()
    np.testing.assert_allclose(
        axes @ axes.transpose(0, 2, 1), known, atol=2e-6 * known.max()
    )
    up = Rotation.from_quat(gltf.nodes[0].rotation).apply([0, -1, 0])
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-9)


def some_splats(count: int = 5) -> Splats:
    rng = np.random.default_rng(0)
    quats = Rotation.random(count, random_state=0).as_quat()
    return Splats(
        means=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        scales=rng.uniform(0.005, 0.02, (count, 3)).astype(np.float32),
        quats=np.roll(quats, 1, axis=1).astype(np.float32),
        opacities=rng.uniform(0.2, 1, count).astype(np.float32),
        sh=rng.uniform(-0.5, 0.5, (count, 4, 3)).astype(np.float32),
    )


def test_splat_files_hold_bytes_of_the_values():
    splats = some_splats()
    raw = np.frombuffer(splat_bytes(splats), np.uint8).reshape(-1, 32)
    means = raw[:, :12].copy().view("<f4")
    order = [int(np.abs(splats.means - mean).sum(1).argmin()) for mean in means]
    assert sorted(order) == list(range(5))
    np.testing.assert_array_equal(means, splats.means[order])
    np.testing.assert_array_equal(
        raw[:, 12:24].copy().view("<f4"), splats.scales[order]
    )
    colour = 0.5 + 0.28209479 * splats.sh[order, 0]
    np.testing.assert_allclose(raw[:, 24:27] / 255, colour, atol=0.003)
    np.testing.assert_allclose(
        raw[:, 27] / 255, splats.opacities[order], atol=0.003
    )
    np.testing.assert_allclose(
        (raw[:, 28:] - 128.0) / 128, splats.quats[order], atol=0.006
    )


def test_spz_files_hold_quantised_columns_with_y_up():
    splats = some_splats()
    raw = np.frombuffer(gzip.decompress(spz_bytes(splats, "z")), np.uint8)
    assert bytes(raw[:4]) == b"NGSP"
    assert raw[4:16].tolist() == [2, 0, 0, 0, 5, 0, 0, 0, 1, 12, 0, 0]
    body = raw[16:]
    assert len(body) == 5 * (9 + 1 + 3 + 3 + 3 + 9)
    fixed = np.zeros((15, 4), np.uint8)
    fixed[:, :3] = body[:45].reshape(-1, 3)
    fixed[:, 3] = np.where(fixed[:, 2] > 127, 255, 0)
    means = fixed.view("<i4").reshape(5, 3) / 4096
    x, y, z = splats.means.T
    np.testing.assert_allclose(means, np.c_[x, z, -y], atol=2e-4)
    np.testing.assert_allclose(body[45:50] / 255, splats.opacities, atol=0.003)
    dc = (body[50:65].reshape(5, 3) / 255 - 0.5) / 0.15
    np.testing.assert_allclose(dc, splats.sh[:, 0], atol=0.02)
    scales = np.exp(body[65:80].reshape(5, 3) / 16 - 10)
    np.testing.assert_allclose(scales, splats.scales, rtol=0.04)

    # The turned Gaussians have turned harmonics: colours of turned directions are the same.
    vector = body[80:95].reshape(5, 3) / 127.5 - 1
    real = np.sqrt(np.clip(1 - (vector**2).sum(1), 0, 1))
    turn = Rotation.from_matrix([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    truth = turn * Rotation.from_quat(np.roll(splats.quats, -1, axis=1))
    off = truth.inv() * Rotation.from_quat(np.c_[vector, real])
    assert np.degrees(off.magnitude()).max() < 6
    rest = (body[95:].reshape(5, 3, 3) - 128.0) / 128
    before = splats.sh[:, 1:]  # of y, z, x with signs - + -
    expected = np.stack([-before[:, 1], -before[:, 0], before[:, 2]], axis=1)
    assert np.abs(np.abs(rest) - np.abs(expected)).max() < 0.05


def test_gsply_reads_spz_files(tmp_path):
    """A reader that no one here wrote; the world already has Y up, so nothing is turned."""
    gsply = pytest.importorskip("gsply.spz")
    splats = some_splats(50)
    path = tmp_path / "a.spz"
    path.write_bytes(spz_bytes(splats, "y"))
    read = gsply.read_spz(path)
    front = splats.means @ to_y_up("y").T
    np.testing.assert_allclose(read.means, front, atol=2e-4)
    np.testing.assert_allclose(np.exp(read.scales), splats.scales, rtol=0.04)
    opacities = 1 / (1 + np.exp(-read.opacities))
    np.testing.assert_allclose(opacities, splats.opacities, atol=0.003)
    np.testing.assert_allclose(read.sh0, splats.sh[:, 0], atol=0.02)
    turned = Rotation.from_matrix(to_y_up("y")) * Rotation.from_quat(
        splats.quats, scalar_first=True
    )
    off = turned.inv() * Rotation.from_quat(read.quats, scalar_first=True)
    assert np.degrees(off.magnitude()).max() < 6


def test_ply2splat_reads_splat_files(tmp_path):
    """A reader that no one here wrote."""
    ply2splat = pytest.importorskip("ply2splat")
    splats = some_splats(50)
    path = tmp_path / "a.splat"
    path.write_bytes(splat_bytes(splats))
    read = list(ply2splat.load_splat_file(str(path)))
    size = splats.opacities * splats.scales.prod(axis=1)
    order = np.argsort(-size, kind="stable")
    means = np.array([splat.position for splat in read])
    np.testing.assert_allclose(means, splats.means[order], rtol=1e-6)
    scales = np.array([splat.scale for splat in read])
    np.testing.assert_allclose(scales, splats.scales[order], rtol=1e-6)
    colour = np.array([splat.color for splat in read]) / 255
    shown = 0.5 + 0.28209479 * splats.sh[order, 0]
    np.testing.assert_allclose(colour[:, :3], shown, atol=0.003)
    np.testing.assert_allclose(
        colour[:, 3], splats.opacities[order], atol=0.003
    )
    quats = np.array([splat.rotation for splat in read]) / 128 - 1
    away = Rotation.from_quat(quats, scalar_first=True).inv() * (
        Rotation.from_quat(splats.quats[order], scalar_first=True)
    )
    assert np.degrees(away.magnitude()).max() < 2


def test_ply2splat_makes_the_same_file_of_a_ply(tmp_path):
    ply2splat = pytest.importorskip("ply2splat")
    splats = some_splats(50)
    (tmp_path / "a.ply").write_bytes(ply_bytes(splats))
    ply2splat.convert(str(tmp_path / "a.ply"), str(tmp_path / "theirs.splat"))
    theirs = np.fromfile(tmp_path / "theirs.splat", np.uint8).reshape(-1, 32)
    ours = np.frombuffer(splat_bytes(splats), np.uint8).reshape(-1, 32)
    rows = [theirs[:, :24].view("<f4"), ours[:, :24].view("<f4")]
    order = [np.lexsort(row[:, :3].T) for row in rows]
    np.testing.assert_allclose(rows[0][order[0]], rows[1][order[1]], rtol=1e-5)
    bytes_apart = theirs[order[0], 24:].astype(int) - ours[order[1], 24:]
    assert np.abs(bytes_apart).max() <= 1
